"""What a machine is, and how fast policies answer on it: `python probe.py facts|latency FILE …` writes a JSON file."""

from __future__ import annotations

import os
import platform
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from notes import update

MATRIX, COPIED = 8192, 2**32  # side of the squares that are multiplied; bytes that are copied


def facts(file: Path) -> None:
    """Describe processor, GPU, driver and renderer, then measure the limits of the GPU if there is one."""
    import torch

    smi = "name,memory.total,driver_version,clocks.max.sm,clocks.max.memory,power.limit"
    update(
        file,
        gpu=_output("nvidia-smi", f"--query-gpu={smi}", "--format=csv"),
        processor=next((line for line in Path("/proc/cpuinfo").read_text().splitlines() if "model name" in line), ""),
        cores=os.cpu_count(),
        memory_gb=round(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / 1e9),
        kernel=platform.release(),
        python=platform.python_version(),
        torch=torch.__version__,
        compiler=_output("g++", "--version").partition("\n")[0],
        egl=[line.strip() for line in _output("ldconfig", "-p").splitlines() if "libEGL" in line],
        vendors=[str(path) for path in Path("/usr/share/glvnd/egl_vendor.d").glob("*.json")],
    )
    update(file, mujoco=_result_of(_mujoco), moderngl=_result_of(_moderngl))
    if torch.cuda.is_available():
        update(file, limits=_limits())


def _output(*command: str) -> str:
    try:
        return subprocess.run(command, capture_output=True, text=True, timeout=30).stdout.strip()
    except (OSError, subprocess.TimeoutExpired) as error:
        return f"{type(error).__name__}: {error}"


def _result_of(work: Callable[[], Any]) -> Any:
    try:
        return work()
    except Exception as error:  # of a driver, of any kind: it is the finding
        return f"{type(error).__name__}: {error}"


def _mujoco() -> str:
    import mujoco

    context = mujoco.GLContext(8, 8)
    context.make_current()
    context.free()
    return mujoco.__version__


def _moderngl() -> dict[str, Any]:
    import moderngl

    began = time.perf_counter()
    options: Any = {"backend": "egl"}
    context: Any = moderngl.create_standalone_context(**options)
    names = ("GL_VENDOR", "GL_RENDERER", "GL_VERSION")
    return {name: context.info[name] for name in names} | {"seconds": round(time.perf_counter() - began, 3)}


def _limits() -> dict[str, float]:
    """Return the rates of copies [TB/s, GB/s] and of matrix products on random data [TFLOP/s], and of launches [µs]."""
    import torch

    def seconds(work: Callable[[], Any], count: int = 15) -> float:
        """Return the median of the times that the GPU takes."""
        marks = [[torch.cuda.Event(enable_timing=True) for _ in range(2)] for _ in range(count)]
        for begin, end in marks:
            begin.record()
            work()
            end.record()
        torch.cuda.synchronize()
        return sorted(begin.elapsed_time(end) for begin, end in marks[3:])[(count - 3) // 2] / 1000

    rates = {}
    pinned = torch.empty(COPIED // 16, dtype=torch.uint8).pin_memory()
    rates["to_device_gb_s"] = pinned.nbytes / seconds(lambda: pinned.to("cuda", non_blocking=True)) / 1e9
    pair = torch.empty(2, COPIED, dtype=torch.uint8, device="cuda")
    rates["copy_tb_s"] = 2 * COPIED / seconds(lambda: pair[0].copy_(pair[1])) / 1e12  # read and written
    kinds = {"bf16": (torch.bfloat16, "high"), "tf32": (torch.float32, "high"), "fp32": (torch.float32, "highest")}
    for name, (dtype, precision) in kinds.items():
        torch.set_float32_matmul_precision(precision)
        matrix = torch.randn(MATRIX, MATRIX, device="cuda").to(dtype)
        rates[f"{name}_tflop_s"] = 2 * MATRIX**3 / seconds(lambda matrix=matrix: matrix @ matrix) / 1e12
    vector = torch.zeros(64, device="cuda")
    torch.cuda.synchronize()
    start = time.perf_counter()
    for _ in range(2000):
        vector.add_(1)
    torch.cuda.synchronize()
    rates["launch_us"] = 1e6 * (time.perf_counter() - start) / 2000
    return {name: round(value, 3) for name, value in rates.items()}


def latency(file: Path, demonstrations: str, episodes: str, plans: str, compiled: str, *models: str) -> None:
    """Measure the time from an observation to its actions of untrained policies: eager, and compiled (CUDA graphs)."""
    import torch

    from vla.config.compose import compose
    from vla.config.experiment import Experiment
    from vla.data.episodes import EpisodeStore

    store, rows = EpisodeStore(Path(demonstrations), int(episodes)), dict[str, Any]()
    for name in models:
        config = compose("job=train", *f"model={name}".split(","), f"collect.folder={demonstrations}", "output=unused")
        model = Experiment.from_config(config).fitted_learner(store).model
        for precision in ("fp32", "bf16")[: 1 + torch.cuda.is_available()]:
            for graphs in (False, True)[: 1 + (compiled == "True")]:
                row = _result_of(partial(_times, model, precision, graphs, int(plans)))
                rows.setdefault(name, {})[f"{precision}{' compiled' if graphs else ''}"] = row
                update(file, latency=rows)


def _times(model: Any, precision: Any, compiled: bool, plans: int) -> dict[str, float]:
    """Return percentiles [ms] over plans with a full history, and the time until the first of them [s]."""
    import numpy as np
    import torch

    from vla.policy import Policy

    torch._dynamo.reset()
    begin, random = time.perf_counter(), np.random.default_rng(0)
    policy = Policy("auto", precision, compiled, 1, model=model, spec=model.spec)
    observations = [policy.spec.random_observation(random) for _ in range(8)]
    for index in range(2 * policy.history + 6):
        policy.plan(observations[index % 8])
    warm_up, times = time.perf_counter() - begin, []
    for index in range(plans):
        started = time.perf_counter()
        policy.plan(observations[index % 8])
        times.append(1000 * (time.perf_counter() - started))
    percentiles = {f"p{share}_ms": float(np.percentile(times, share)) for share in (50, 99, 100)}
    return {name: round(value, 3) for name, value in percentiles.items()} | {"warm_s": round(warm_up, 1)}


if __name__ == "__main__":
    {measure.__name__: measure for measure in (facts, latency)}[sys.argv[1]](Path(sys.argv[2]), *sys.argv[3:])
