"""Measure vla in the few minutes for which there is a GPU: `python tools/gpu/minutes.py OUT [STEP …]`, see docs/gpu.md.

Every step has a file in OUT, which is written again after each of its commands; every command has a limit of its own.
Standard library only, because it runs before anything is unpacked.
"""

from __future__ import annotations

import argparse
import os
import shutil
import signal
import subprocess
import sys
import tarfile
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

from notes import compiling_of, figures_of, rates_of, update

ROOT, PROBE = Path(__file__).resolve().parents[2], Path(__file__).with_name("probe.py")
GRACE = 15  # [s] between an interrupt and the end by force
LEAST = 8  # [s] with which a command is still started
NVIDIA = Path("/usr/local/nvidia/share/glvnd/egl_vendor.d/10_nvidia.json")  # where some containers mount the driver
BY_MESA = "demonstrations_by_mesa"
NEVER = 1_000_000  # batches: without a validation


class Sizes(NamedTuple):
    """How much is measured."""

    workers: int
    demonstrations: int  # collected, with the GPU's renderer
    compared: int  # collected, with the software renderer
    used: int  # demonstrations that most trainings read
    model: str  # the large one
    batch: int
    timed: int  # steps
    trained: int  # steps of bc
    evaluated: int  # episodes
    plans: int
    precision: str
    compiled: bool
    device: str  # trainer.accelerator
    vlas: dict[str, str]  # vision-language-action model → what LoRA freezes
    slower: int = 1  # factor of all limits


TINY = {"smolvla_tiny": "network.vlm"}
FULL = {"smolvla": "network.vlm", "pi0": "network.paligemma"}
DRY = Sizes(1, 6, 3, 6, "rt1_tiny", 4, 2, 3, 1, 3, "fp32", False, "cpu", TINY, 10)


def real() -> Sizes:
    """Return the sizes for the GPU of this machine: rt1 was estimated at 2.25 GB per window."""
    query = ["nvidia-smi", "--query-gpu=memory.total", "--format=csv,noheader,nounits"]
    memory = int(subprocess.run(query, capture_output=True, text=True, check=True).stdout.split()[0])  # [MiB]
    batch = 40 if memory > 100_000 else 24
    return Sizes(
        len(os.sched_getaffinity(0)), 2000, 1000, 500, "rt1", batch, 12, 2000, 200, 200, "bf16", True, "gpu", FULL
    )


class Minutes:
    """The steps, each a method of one letter, in the time that there is.

    Args:
        out: folder of the results.
        work: folder of everything else.
        kit: folder that `pack.py` made, or None if nothing is missing here.
        sizes: how much to measure.
        total: time for all steps [s].
        learn: time for training in `d` [s].
        steps: of the training in `d`; None: as many as there is time for, by the rate of `c`.
        overrides: of the training in `d`.
    """

    def __init__(
        self,
        out: Path,
        work: Path,
        kit: Path | None,
        sizes: Sizes,
        total: float,
        learn: int,
        steps: int | None,
        overrides: list[str],
    ) -> None:
        self.out, self.work, self.kit, self.sizes = out.resolve(), work.resolve(), kit, sizes
        self.learn, self.steps, self.overrides = learn, steps, overrides
        self._end = time.monotonic() + total
        for folder in (self.out, self.work):
            folder.mkdir(parents=True, exist_ok=True)
        self._demonstrations = self.work / "demonstrations"
        paths = [str(self.work / "site"), str(ROOT), os.environ.get("PYTHONPATH", "")]
        self.environment = {
            **os.environ,
            "PYTHONPATH": os.pathsep.join(filter(None, paths)),
            "MUJOCO_GL": "egl",
            "HF_HUB_OFFLINE": "1",
            "PYTHONWARNINGS": "ignore",
            "VLA_TRACEBACKS": "1",
        }
        if kit is not None:
            self._unpack(kit)
        if (self.work / BY_MESA / "store.json").exists():  # in an earlier call the GPU did not draw
            self._draw_by_mesa()

    @property
    def left(self) -> float:
        """Time left [s]."""
        return self._end - time.monotonic()

    def _unpack(self, kit: Path) -> None:
        """Unpack the packages and, where there are none, the loaders of OpenGL, which only work in their place."""
        for name in ("site", "mesa"):
            archive = kit / f"{name}.tar.xz"
            folder = self.work / name
            if archive.exists() and not (folder.exists() and folder.stat().st_mtime >= archive.stat().st_mtime):
                shutil.rmtree(folder, ignore_errors=True)  # of an older kit
                with tarfile.open(archive) as files:
                    files.extractall(self.work, filter="data")
                os.utime(folder)
        libraries = subprocess.run(["ldconfig", "-p"], capture_output=True, text=True).stdout
        if "libEGL.so.1" not in libraries and self.sizes.device == "gpu":
            for package in sorted(kit.glob("gl/*.deb")):
                subprocess.run(["dpkg", "-x", str(package), "/"], check=True)
            subprocess.run(["ldconfig"], check=True)
        if NVIDIA.exists() and not Path("/usr/share/glvnd/egl_vendor.d", NVIDIA.name).exists():
            self.environment["__EGL_VENDOR_LIBRARY_FILENAMES"] = str(NVIDIA)

    def run(self, step: str, name: str, limit: float, *command: str, **more: str) -> dict[str, Any]:
        """Run a command of a step for at most `limit` seconds, and return what is noted of it in the step's file.

        `more` are further environment variables.
        """
        limit = min(limit * self.sizes.slower, self.left - 5)
        notes: dict[str, Any] = {"command": " ".join(command[-12:]), "limit_s": round(limit), "status": None}
        if limit >= LEAST:
            start, log = time.monotonic(), self.work / f"{name}.log"
            cwd, env = self.work, {**self.environment, **more}
            with log.open("wb") as file:
                process = subprocess.Popen(command, cwd=cwd, env=env, stdout=file, stderr=file, start_new_session=True)
                notes["status"] = _exit_status(process, limit)
            text = log.read_text(errors="replace").replace("\r", "\n")
            notes |= {
                "seconds": round(time.monotonic() - start, 1),
                "log": [line[:400] for line in text.split("\n")[-40:]],
            }
        print(f"{step} {name}: status {notes['status']}, {notes.get('seconds')} s; {self.left:.0f} s left", flush=True)
        return self.note(step, name, notes)

    def note(self, step: str, name: str, values: dict[str, Any]) -> dict[str, Any]:
        """Write values into the file of a step, and return them."""
        update(self.out / f"{step}.json", **{name: values})
        return values

    def vla(self, step: str, name: str, limit: float, *overrides: str, **more: str) -> dict[str, Any]:
        """Run a job of vla, and note its figures, too."""
        output = self.work / "runs" / name
        command = [sys.executable, "-m", "vla.run", "recorder=none", f"cluster.workers={self.sizes.workers}"]
        notes = self.run(step, name, limit, *command, *overrides, f"output={output}", **more)
        return self.note(step, name, notes | figures_of(output))

    def data(self, episodes: int) -> list[str]:
        """Return the overrides that use that many of the collected demonstrations."""
        return [f"collect.folder={self._demonstrations}", f"collect.episodes={episodes}"]

    def a(self) -> None:
        """Note what this machine is, and what its GPU can do at most."""
        self.run("a", "facts", 60, sys.executable, str(PROBE), "facts", str(self.out / "a.json"))

    def b(self) -> None:
        """Collect demonstrations: drawn by the GPU, and by Mesa's software renderer if that is packed."""
        sizes = self.sizes
        collected = self.vla("b", "collect", 170, "job=collect", *self.data(sizes.demonstrations))
        if not (self.work / "mesa").exists():
            return
        if collected["status"] == 0:
            overrides = [f"collect.folder={self.work / 'compared'}", f"collect.episodes={sizes.compared}"]
            self.vla("b", "collect_by_mesa", 60, "job=collect", *overrides, **self._mesa())
        else:  # the other steps need demonstrations, and draw in the same way
            self._draw_by_mesa()
            self.vla("b", "collect_by_mesa", 170, "job=collect", *self.data(sizes.demonstrations))

    def _draw_by_mesa(self) -> None:
        """Use Mesa, and demonstrations that it has drawn, from now on."""
        self.environment |= self._mesa()
        self._demonstrations = self.work / BY_MESA

    def _mesa(self) -> dict[str, str]:
        folder, path = self.work / "mesa", os.environ.get("LD_LIBRARY_PATH")  # which may lead to the GPU's driver
        return {
            "LD_LIBRARY_PATH": os.pathsep.join(filter(None, (str(folder / "lib"), path))),
            "LIBGL_DRIVERS_PATH": str(folder / "dri"),
            "__EGL_VENDOR_LIBRARY_FILENAMES": str(folder / "vendor.json"),
            "EGL_PLATFORM": "surfaceless",
            "GALLIUM_DRIVER": "llvmpipe",
        }

    def c(self) -> None:
        """Time the training of the large model: eager, then compiled, which may take longer than there is time."""
        self.rate("c", "eager", 70, self.sizes.batch, self.sizes.precision, False)
        if self.sizes.compiled:
            self.rate("c", "compiled", 150, self.sizes.batch, self.sizes.precision, True)

    def rate(self, step: str, name: str, limit: float, batch: int, precision: str, compiled: bool) -> None:
        """Time a training of the large model."""
        sizes = self.sizes
        timing = [f"benchmark.steps={sizes.timed}", "benchmark.rounds=1", f"benchmark.compile=[{compiled}]"]
        training = [f"model={sizes.model}", f"trainer.accelerator={sizes.device}", f"data.batch_size={batch}"]
        job = ["job=benchmark", "benchmark.names=[train]", f"benchmark.precisions=[{precision}]"]
        self.vla(step, name, limit, *job, *timing, *training, *self.data(sizes.used))

    def d(self) -> None:
        """Train the large model for as long as there is time, in the way that c found faster, and evaluate it.

        It compiles another graph than c, with what `overrides` change, and ends in time to write its policy.
        """
        sizes, seconds = self.sizes, min(self.learn, self.left - 120)  # 30 s to start, 90 s to evaluate
        rates = rates_of(self.out / "c.json") or {"eager": 5.0 * sizes.batch}
        gains = {kind: rate * (seconds - compiling_of(self.out / "c.json", kind)) for kind, rate in rates.items()}
        fastest = max(gains, key=lambda kind: gains[kind])
        steps = self.steps or max(20, int(0.93 * gains[fastest] / sizes.batch))
        model = [f"model={sizes.model}", "learner.lr=5e-4", f"data.batch_size={sizes.batch}", *self.overrides]
        length = [*self.data(sizes.demonstrations), f"+trainer.max_time={{seconds: {max(seconds, 1):.0f}}}"]
        self.train("d", "rt1", seconds + 30, steps, fastest == "compiled", *length, *model)

    def g(self) -> None:
        """Train bc, and evaluate it."""
        overrides = ["model=bc", *self.data(self.sizes.used)]
        self.train("g", "bc", 90, self.sizes.trained, self.sizes.compiled, *overrides)

    def train(self, step: str, name: str, limit: float, steps: int, compiled: bool, *overrides: str) -> None:
        """Train a policy without validations, eager if it cannot be compiled, then evaluate it."""
        sizes = self.sizes
        settings = [
            f"trainer.accelerator={sizes.device}",
            f"trainer.precision={sizes.precision}",
            f"trainer.max_steps={steps}",
        ]
        settings += [f"trainer.val_check_interval={NEVER}", f"trainer.log_every_n_steps={min(20, steps)}"]
        settings += ["job=train", "validate.episodes=0", *overrides]
        for run in (name, f"{name}_eager", f"{name}_evaluated", f"{name}_eager_evaluated"):
            shutil.rmtree(self.work / "runs" / run, ignore_errors=True)  # of an earlier call
        notes = self.vla(step, name, limit, f"learner.compile={compiled}", *settings)
        if compiled and notes["status"] not in (0, None):
            name = f"{name}_eager"
            notes = self.vla(step, name, limit, "learner.compile=False", *settings)
        if notes["status"] == 0:
            trials = [f"checkpoint={self.work / 'runs' / name}", f"evaluate.episodes={sizes.evaluated}"]
            trials += ["cluster.policy=here", f"policy.lanes={min(sizes.workers, 16)}"] if sizes.device == "gpu" else []
            self.vla(step, f"{name}_evaluated", 150, *trials)

    def e(self) -> None:
        """Time single decisions of policies."""
        sizes = self.sizes
        inputs = [str(self._demonstrations), str(sizes.used), str(sizes.plans), str(sizes.compiled)]
        models = ["bc", sizes.model, "act", "flow"]
        self.run("e", "command", 110, sys.executable, str(PROBE), "latency", str(self.out / "e.json"), *inputs, *models)

    def f(self) -> None:
        """Train a few steps with the strategies for several devices, on one."""
        sizes = self.sizes
        for strategy in ("ddp", "fsdp"):
            trainer = [f"trainer={strategy}", "trainer.devices=1", f"trainer.accelerator={sizes.device}"]
            length = [f"trainer.max_steps={sizes.timed + 8}", f"trainer.val_check_interval={NEVER}"]
            model = ["model=rt1_tiny", "validate.episodes=0", f"trainer.precision={sizes.precision}"]
            self.vla("f", strategy, 60, "job=train", *trainer, *length, *model, *self.data(sizes.used))

    def v(self) -> None:
        """Take ten steps of LoRA with vision-language-action models of random weights, and time their plans."""
        sizes = self.sizes
        for name, frozen in sizes.vlas.items():
            model = [f"model={name}", "model.text.name=null", "learner=smolvla", "learner/lora=low_rank"]
            length = ["trainer.max_steps=10", f"trainer.val_check_interval={NEVER}", "validate.episodes=0"]
            method = [
                f"trainer.accelerator={sizes.device}",
                f"trainer.precision={sizes.precision}",
                f"learner.frozen=[{frozen}]",
            ]
            self.vla("v", name, 120, "job=train", "data.batch_size=8", *model, *length, *method, *self.data(sizes.used))
        models = [f"{name},model.text.name=null" for name in sizes.vlas]
        inputs = [str(self._demonstrations), str(sizes.used), str(sizes.plans), str(sizes.compiled)]
        self.run("v", "plans", 110, sys.executable, str(PROBE), "latency", str(self.out / "v.json"), *inputs, *models)

    def h(self) -> None:
        """Time rendering, other sizes of a batch, and TensorFloat-32."""
        sizes = self.sizes
        self.vla("h", "rendering", 60, "job=benchmark", "benchmark.names=[collect]", "benchmark.episodes=3")
        for batch in (max(sizes.batch // 3, 2), sizes.batch * 4 // 3):
            self.rate("h", f"batch_{batch}", 45, batch, sizes.precision, False)
        self.rate("h", "tf32", 60, max(sizes.batch // 2, 2), "fp32", False)  # which takes twice the memory


def _exit_status(process: subprocess.Popen[bytes], limit: float) -> int | str:
    """Wait for a process, interrupt it after `limit` seconds, and end all that it started; returns its status."""
    try:
        return process.wait(limit)
    except subprocess.TimeoutExpired:
        process.send_signal(signal.SIGINT)
        with suppress(subprocess.TimeoutExpired):
            process.wait(GRACE)
        return "ran past its limit"
    finally:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()


STEPS: dict[str, Callable[[Minutes], None]] = {
    name: getattr(Minutes, name) for name in ("a", "b", "g", "c", "e", "d", "f", "v", "h")
}


def main() -> None:
    """Run the steps of the command line in their order."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, help="folder of the results")
    parser.add_argument("steps", nargs="*", default=["a", "b", "g", "c", "e"], help=f"of {' '.join(STEPS)}")
    parser.add_argument("--kit", type=Path, help="folder that pack.py made")
    parser.add_argument("--work", type=Path, default=Path("/tmp/gpu_minutes"), help="folder of everything else")
    parser.add_argument("--total", type=float, default=580, help="time for all steps [s]")
    parser.add_argument("--learn", type=int, default=220, help="time for training in step d [s]")
    parser.add_argument(
        "--number", type=int, help="of training steps in step d; by default as many as there is time for"
    )
    parser.add_argument("--rt1", nargs="*", default=["model.auxiliary=1.0"], metavar="KEY=VALUE", help="for step d")
    parser.add_argument("--dry", action="store_true", help="tiny sizes on a CPU")
    options = parser.parse_args()
    if unknown_steps := [step for step in options.steps if step not in STEPS]:
        parser.error(f"there is no step {unknown_steps[0]}; there are {' '.join(STEPS)}")
    sizes = DRY if options.dry else real()
    count = sizes.trained if options.dry else options.number
    minutes = Minutes(options.out, options.work, options.kit, sizes, options.total, options.learn, count, options.rt1)
    for step in options.steps:
        STEPS[step](minutes)


if __name__ == "__main__":
    main()
