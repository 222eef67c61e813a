"""Compare what trainings say that they need with what they take: python tools/estimates.py [KEY=VALUE …].

Overrides are for all of them. Times are of the processor, so that they also hold beside other programs; on idle cores
a step takes as long.
"""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

LARGE = ("model=act", "model.width=512", "model.layers=6", "model.heads=8", "data.batch_size=16")
IN_PARTS = ("learner/lora=low_rank", "learner.lora.modules=[encoder,decoder]", "learner.frozen=[encoder,decoder]")
TRAININGS: dict[str, tuple[str, ...]] = {
    **{f"`{model}`": (f"model={model}",) for model in ("bc", "rt1_tiny", "act", "flow", "decoder")},
    "`act` of 68 M parameters, batches of 16": LARGE,
    "the same, `learner.checkpointing=true`": (*LARGE, "learner.checkpointing=true"),
    "the same with LoRA": (*LARGE, "learner.checkpointing=true", *IN_PARTS),
}
SHORT = ("job=train", "trainer.accelerator=cpu", "trainer.max_steps=40", "validate.episodes=0", "logger=none")
PROGRAM = """
import time
from types import SimpleNamespace
from vla.run import main
from vla.training import device, estimate
device.time = estimate.time = SimpleNamespace(perf_counter=time.process_time)
main()
"""
SAID = r"about ([\d.]+) of [\d.]+ GB of memory \(it holds ([\d.]+)\)"
TOOK = r"took ([\d.]+) GB of memory and (\d+) ms for a batch, after an estimate of [\d.]+ GB and (\d+) ms"


def main(overrides: list[str]) -> None:
    """Train, one after the other, and print a row of a table for each."""
    print(
        "| training | memory [GB]: said | taken | at its start | a step [ms]: said | taken |\n|---|---|---|---|---|---|"
    )
    for name, options in TRAININGS.items():
        with TemporaryDirectory() as folder:
            output = (f"output={folder}/run", f"hydra.run.dir={folder}/run")
            command = [sys.executable, "-c", PROGRAM, *SHORT, *options, *output, *overrides]
            process = subprocess.run(command, capture_output=True, text=True, cwd=Path.cwd())
        text = " ".join(process.stdout.split())
        estimate, measure = re.search(SAID, text), re.search(TOOK, text)
        if estimate is None or measure is None:
            sys.exit(process.stdout + process.stderr)
        print(f"| {name} | {estimate[1]} | {measure[1]} | {estimate[2]} | {measure[3]} | {measure[2]} |", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
