"""Who may import whom, and what the entry may not wait for."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest
import warm
from command_line import SMALL

ROOT = Path(__file__).parents[1]
MODULES = {
    ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path
    for path in sorted((ROOT / "vla").rglob("*.py"))
}

# Parts import those of the rows above and nothing of their own row but themselves, lazy imports counted.
LAYERS = (
    ("vla.io",),
    ("vla.spec", "vla.parallel", "vla.schedule"),
    ("vla.robots",),
    ("vla.models", "vla.data", "vla.tasks"),
    ("vla.policy", "vla.rollouts"),
    ("vla.config", "vla.deploy"),
    ("vla.runs", "vla.envs"),
    ("vla.training", "vla.reports", "vla.api"),
    ("vla.jobs",),
    ("vla.run",),
)

# A part → the only others that may import it. Worlds are built from a configuration.
ONLY_FOR = {"vla.robots": ("vla.tasks", "vla.deploy"), "vla.tasks": ()}

# A library → the only parts that may import it.
LIBRARIES = {
    "hydra": ("vla.run", "vla.config", "vla.jobs.sweep"),
    "omegaconf": ("vla.run", "vla.config", "vla.jobs.sweep"),
    "mujoco": ("vla.tasks", "vla.jobs.benchmark"),
    "dm_control": ("vla.tasks",),
    "moderngl": ("vla.tasks.rendering",),
    "fast_simplification": ("vla.tasks.rendering.decimate",),
    "dm_env": ("vla.envs",),
    "gymnasium": ("vla.envs", "vla.tasks.gymnasium"),
    "lightning": ("vla.models.learner", "vla.data.datamodule", "vla.training", "vla.runs", "vla.jobs"),
    "rerun": ("vla.rollouts.recorder",),
    "rclpy": ("vla.deploy",),
    "torch": (
        *("vla.models", "vla.policy", "vla.training", "vla.data.datamodule", "vla.data.window_batches", "vla.jobs"),
        *("vla.data.image_codec", "vla.io.images", "vla.config", "vla.deploy.onnx_policy"),  # when they need it
    ),
    "timm": ("vla.models.vision.timm_encoders",),
    "peft": ("vla.models.lora",),
    "transformers": ("vla.models.text.huggingface", "vla.models.vlm"),
}
HEAVY = ("torch", "lightning", "mujoco", "dm_control", "rerun", "matplotlib")


def within(module: str, parts: tuple[str, ...]) -> bool:
    return any(f"{module}.".startswith(f"{part}.") for part in parts)


def importable_by(module: str) -> tuple[str, ...]:
    """The parts that a module may import: its own, and those of the rows above."""
    for number, layer in enumerate(LAYERS):
        for part in layer:
            if within(module, (part,)):
                lower = [below for row in LAYERS[:number] for below in row]
                return (part, *(below for below in lower if within(module, ONLY_FOR.get(below, (module,)))))
    raise AssertionError(f"say in LAYERS where {module} belongs")


def imports(node: ast.AST) -> Iterator[str]:
    """Dotted names of all modules imported in `node`."""
    for child in ast.walk(node):
        if isinstance(child, ast.Import):
            yield from (alias.name for alias in child.names)
        elif isinstance(child, ast.ImportFrom):
            assert child.level == 0, "imports are absolute"
            names = [f"{child.module}.{alias.name}" for alias in child.names]
            yield from (name if name in MODULES else str(child.module) for name in names)


@cache
def references(module: str, source: str) -> set[str]:
    """Modules that `module` imports anywhere, for type checkers included, or names in a string to import them later."""
    tree = ast.parse(source)
    named = set(imports(tree))
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and node.value.startswith("vla."):
            package, _, name = node.value.rpartition(".")
            in_package = {each for each in MODULES if package != "vla" and each.rpartition(".")[0] == package}
            named |= {node.value, package} if name else in_package  # the name of a module or class, or its start
    return {name for name in named if name in MODULES and name != module}


def require_no_circle(sources: dict[str, str]) -> None:
    TopologicalSorter({module: references(module, source) for module, source in sources.items()}).prepare()


def test_no_imports_go_in_a_circle() -> None:
    sources = {module: path.read_text(encoding="utf-8") for module, path in MODULES.items()}
    require_no_circle(sources)
    for lazy in (
        "def later() -> None:\n    from vla.models.bc import BC",
        "if TYPE_CHECKING:\n    from vla.models.bc import BC",
        "import_module('vla.models.bc')",
        "import_module(f'vla.models.{name}')",
    ):
        with pytest.raises(CycleError):
            require_no_circle({**sources, "vla.io.types": f"{sources['vla.io.types']}\n{lazy}\n"})


@pytest.mark.parametrize("module", [module for module in MODULES if module != "vla"])
def test_parts_import_only_what_they_may(module: str) -> None:
    names = set(imports(ast.parse(MODULES[module].read_text(encoding="utf-8"))))
    allowed = importable_by(module)
    assert [name for name in names if within(name, ("vla",)) and not within(name, allowed)] == []
    for library, users in LIBRARIES.items():
        if not within(module, users):
            assert [name for name in names if within(name, (library,))] == []


def test_the_default_config_is_checked_before_its_job_is_imported(tmp_path: Path) -> None:
    code = """
import sys
import vla.run
def told(*_):
    print(*(name for name in sys.modules if name.split(".")[0] == "vla"))
    sys.exit()
vla.run.check = told
sys.argv = ["vla"]
vla.run.main()
"""
    here = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, env=here, capture_output=True, text=True)
    modules = [name for name in done.stdout.split() if MODULES[name].read_bytes().count(b"\n") > 1]
    assert "vla.config.check" in modules and len(modules) <= 35, sorted(modules)


def test_training_and_deployment_need_no_simulator(home: Path) -> None:
    train = [*SMALL, "job=train", "output=without"]
    code = f"""
import sys
sys.modules.update(dict.fromkeys(["mujoco", "dm_control", "moderngl"]))  # as if they were not installed
from vla.run import main
sys.argv[1:] = {train}
main()
from vla.config.adopt import adopt
from vla.config.check import check
from vla.config.compose import compose
from vla.config.experiment import Experiment
from vla.jobs import find
robot = ["job=deploy", "deploy=server", "output=served", "checkpoint=without"]
check(Experiment.from_config(adopt(compose(*robot), robot)), find("deploy"))
sys.argv[1:] += ["output=further", "collect.episodes=13"]
main()
"""
    (home / "no_simulator.py").write_text(code)
    done = warm.run(home, program="no_simulator")
    assert (home / "without/checkpoints/last.ckpt").is_file(), done.stderr
    assert "Tabletop, which cannot be imported" in done.stderr and "Traceback" not in done.stderr
    assert done.stderr.count("error:") == 1 and not (home / "further/checkpoints/last.ckpt").exists()


@pytest.mark.parametrize(
    ("module", "library"),
    [
        ("vla.training.player", "lightning"),
        ("vla.jobs.deploy", "matplotlib"),
        ("vla.jobs.plan", "matplotlib"),
        ("vla.tasks.tabletop.environment", "scipy"),
    ],
)
def test_processes_do_not_import_what_they_do_not_use(module: str, library: str) -> None:
    code = f"import sys, {module}; sys.exit('{library}' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], cwd=ROOT).returncode == 0


def test_only_worlds_of_mujoco_choose_its_backend_and_before_they_import_it() -> None:
    worlds = {
        module.rpartition(".")[0]
        for module, path in MODULES.items()
        if within(module, ("vla.tasks",)) and not within(module, ("vla.tasks.rendering",))
        if {name.partition(".")[0] for name in imports(ast.parse(path.read_text(encoding="utf-8")))} & {"mujoco"}
    }
    choosing = {m for m in MODULES if "vla.tasks.gl" in references(m, MODULES[m].read_text(encoding="utf-8"))}
    assert worlds <= choosing and all(within(module, ("vla.tasks",)) for module in choosing)


MENU = (
    "task/goal: chain, lift, mixed, pick_place, pick_place_or_stay, pick_place_two, ",
    "  evaluate    The default: collect, train and report a success rate",
)


@pytest.mark.parametrize(
    ("question", "words"),
    [("--help", MENU), ("--cfg job --resolve", ("chosen:\n  experiment: null\n  model: bc\n",))],
)
def test_questions_are_answered_without_heavy_imports(question: str, words: tuple[str, ...]) -> None:
    command = [sys.executable, "-X", "importtime", "-m", "vla.run", *question.split()]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr[-500:]
    assert all(each in done.stdout for each in words), done.stdout
    imported = {line.rpartition("|")[2].strip() for line in done.stderr.splitlines()}
    assert "vla.config.check" in imported
    assert imported.isdisjoint(HEAVY)


def test_a_policy_acts_without_compiler_and_trainer() -> None:
    """Which take seconds to import: evaluations, nodes and workers start and end without them."""
    code = (
        "import sys, vla.jobs.evaluate, vla.models.rt1; from pathlib import Path\n"
        "from fake_batch import make_bc; from toy import ARM_SPEC; from vla.models.policy_folder import TensorBudget\n"
        "with TensorBudget(Path(), 2**30):\n"
        "    assert make_bc(spec=ARM_SPEC).robot_state.kinematics is not None\n"
        "print(*sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT / "tests", capture_output=True, text=True, timeout=60)
    assert "vla.jobs.evaluate" in done.stdout, done.stderr[-500:]
    assert {"torch._dynamo", "lightning"}.isdisjoint(done.stdout.split())
