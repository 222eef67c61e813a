"""Who may import whom, and what the entry may not wait for."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
MODULES = {
    ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path
    for path in sorted((ROOT / "vla").rglob("*.py"))
}

# What describes and reads plain values, and writes files; it imports nothing of the package.
EVERYWHERE = ("vla.types", "vla.documents", "vla.files")
# A part of the package → the parts that its modules may import; the entry and the jobs may import everything.
PARTS = {
    "vla.spec": (),
    "vla.tasks": ("vla.spec", "vla.tasks"),
    "vla.data": ("vla.spec", "vla.data", "vla.workers"),
    "vla.models": ("vla.spec", "vla.models"),
    "vla.policy": ("vla.spec", "vla.models"),
    "vla.program": ("vla.spec", "vla.models", "vla.policy"),
    "vla.rollout": ("vla.spec",),
    "vla.record": ("vla.spec",),
    "vla.files": (),
    "vla.workers": (),
    "vla.ending": (),
    "vla.cluster": ("vla.workers",),
    "vla.collect": ("vla.spec", "vla.rollout", "vla.data", "vla.cluster", "vla.workers"),
    "vla.intervals": (),
    "vla.evaluate": ("vla.spec", "vla.intervals", "vla.rollout", "vla.record", "vla.workers"),
    "vla.factors": ("vla.spec", "vla.evaluate"),
    "vla.report": ("vla.spec", "vla.intervals", "vla.evaluate", "vla.factors"),
    "vla.suite": ("vla.evaluate", "vla.report"),
    "vla.sweep": ("vla.intervals", "vla.evaluate", "vla.results", "vla.page", "vla.sweep_plot"),
    "vla.sweep_plot": ("vla.intervals", "vla.results", "vla.sweep"),
    "vla.run_files": ("vla.evaluate",),
    "vla.results": ("vla.spec", "vla.evaluate", "vla.run_files"),
    "vla.processor": ("vla.check",),
    "vla.film": (),
    "vla.curves": ("vla.report", "vla.results"),
    "vla.samples": ("vla.spec", "vla.report"),
    "vla.page": ("vla.evaluate", "vla.report", "vla.suite", "vla.results", "vla.curves", "vla.film"),
    "vla.card": ("vla.spec", "vla.data", "vla.report"),
    "vla.deploy": (
        *("vla.spec", "vla.policy", "vla.tasks", "vla.data", "vla.evaluate", "vla.record", "vla.deploy"),
        *("vla.documents", "vla.types"),
    ),
    "vla.stores": ("vla",),
    "vla.types": (),
    "vla.documents": (),
    "vla.annotations": (),
    "vla.check": ("vla.annotations", "vla.spec"),
    "vla.peers": ("vla.workers",),
    "vla.resume": ("vla.check", "vla.policy", "vla.results"),
    "vla.progress": ("vla.models",),
    "vla.averaging": ("vla.models",),
    "vla.validation": ("vla.spec", "vla.models", "vla.intervals", "vla.evaluate"),
    "vla.trainer": ("vla.averaging", "vla.check", "vla.progress", "vla.resume", "vla.workers"),
    "vla.train": ("vla",),
    "vla.benchmark": ("vla",),
    "vla.parts": ("vla",),
    "vla.jobs": ("vla",),
    "vla.run": ("vla",),
}

# A library → the only parts that may import it.
LIBRARIES = {
    "hydra": ("vla.run", "vla.jobs", "vla.parts", "vla.check", "vla.benchmark", "vla.sweep", "vla.resume"),
    "omegaconf": (
        *("vla.run", "vla.jobs", "vla.parts", "vla.check", "vla.benchmark", "vla.sweep", "vla.resume"),
        *("vla.train", "vla.trainer"),
    ),
    "mujoco": ("vla.tasks", "vla.benchmark"),
    "dm_control": ("vla.tasks",),
    "dm_env": ("vla.tasks",),
    "lightning": (
        *("vla.models.learner", "vla.data.windows", "vla.trainer", "vla.progress", "vla.validation", "vla.resume"),
        *("vla.averaging", "vla.train", "vla.benchmark"),
    ),
    "rerun": ("vla.record", "vla.film", "vla.deploy.view"),
    "rclpy": ("vla.deploy",),
    "distributed": ("vla.cluster",),
    "timm": ("vla.models.trunks",),
    "transformers": ("vla.models.huggingface",),
}
HEAVY = ("torch", "lightning", "mujoco", "dm_control", "rerun", "matplotlib", "distributed")


def within(module: str, parts: tuple[str, ...]) -> bool:
    return any(f"{module}.".startswith(f"{part}.") for part in parts)


def part_of(module: str) -> str:
    return max((part for part in PARTS if within(module, (part,))), key=len)


def imports(node: ast.AST) -> Iterator[str]:
    """Dotted names of all modules imported in `node`."""
    for child in ast.walk(node):
        if isinstance(child, ast.Import):
            yield from (alias.name for alias in child.names)
        elif isinstance(child, ast.ImportFrom):
            assert child.level == 0, "imports are absolute"
            names = [f"{child.module}.{alias.name}" for alias in child.names]
            yield from (name if name in MODULES else str(child.module) for name in names)


def imports_at_once(path: Path) -> Iterator[str]:
    """Those that run when the module is imported, rather than in a function or for type checkers only."""
    for statement in ast.parse(path.read_text(encoding="utf-8")).body:
        typing_only = isinstance(statement, ast.If) and "TYPE_CHECKING" in ast.unparse(statement.test)
        if not typing_only and not isinstance(statement, (ast.FunctionDef, ast.ClassDef)):
            yield from imports(statement)


@pytest.mark.parametrize("module", [module for module in MODULES if module != "vla"])
def test_parts_import_only_what_they_may(module: str) -> None:
    assert any(within(module, (part,)) for part in PARTS), f"say in PARTS what {module} may import"
    names = set(imports(ast.parse(MODULES[module].read_text(encoding="utf-8"))))
    allowed = (*PARTS[part_of(module)], *EVERYWHERE)
    assert [name for name in names if within(name, ("vla",)) and not within(name, allowed)] == []
    for library, users in LIBRARIES.items():
        if not within(module, users):
            assert [name for name in names if within(name, (library,))] == []


def test_the_simulator_needs_no_torch() -> None:
    for module, path in MODULES.items():
        if within(module, ("vla.tasks", "vla.spec", "vla.rollout", "vla.cluster", "vla.collect")):
            assert not {name.split(".")[0] for name in imports(ast.parse(path.read_text(encoding="utf-8")))} & {"torch"}


@pytest.mark.parametrize("module", ["vla.run", "vla.check", "vla.jobs", "vla.parts"])
def test_the_entry_imports_nothing_heavy_at_once(module: str) -> None:
    assert [name for name in imports_at_once(MODULES[module]) if within(name, HEAVY)] == []


@pytest.mark.parametrize("option", [["--help"], ["--cfg", "job"], ["--cfg", "job", "--resolve"]])
def test_questions_are_answered_without_heavy_imports(option: list[str]) -> None:
    command = [sys.executable, "-X", "importtime", "-m", "vla.run", *option]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=20)
    assert done.returncode == 0, done.stderr[-500:]
    assert "evaluate" in done.stdout
    imported = {line.rpartition("|")[2].strip() for line in done.stderr.splitlines()}
    assert "vla.check" in imported
    assert imported.isdisjoint(HEAVY)


def test_a_policy_acts_without_the_compiler() -> None:
    """Which takes a second to import, and another one to leave: nodes and workers start and end without it."""
    code = "import sys, vla.policy, vla.models.bc, vla.models.rt1; sys.exit('torch._dynamo' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], cwd=ROOT, timeout=60).returncode == 0
