"""What the user can mend, at the command line: one sentence for each way to it, before any work."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from command_line import SMALL, here
from composing import check, composed

from vla.config.build import build
from vla.config.experiment import plain
from vla.tasks.gl import WORKING_BACKEND

BAD_INPUT = {
    "misspelt key": (("colect.episodes=3",), "collect"),
    "misspelt option": (("model=rt2",), "rt1"),
    "wrong type": (("trainer.max_steps=many",), "trainer.max_steps must be "),
    "missing policy": (("checkpoint=nowhere",), "there is no policy"),
    "a file for a policy": (("checkpoint=nowhere.ckpt",), "only resumes its own training: a policy is a folder"),
    "a folder without a policy": (("checkpoint=.",), ". is neither a policy nor a run with one"),
    "a deployment without a policy": (("job=deploy", "deploy=loop"), "this deployment needs a trained policy"),
    "a run that is no path": (("resume=true",), "resume=True is not a path"),
    "a checkpoint that is no path": (("checkpoint=3",), "checkpoint=3 is not a path"),
    "nothing interrupted": (
        ("resume=last", "output=nowhere/now"),
        "no run in nowhere was interrupted",
    ),
    "no room on the table": (("job=preview", "task.blocks=4", "task.randomize.placement.x=[0.5,0.5]"), "no room"),
    "no dataset": (("job=collect", "expert=lerobot", "expert.folder=nowhere"), "no LeRobot dataset in nowhere"),
    "nothing to compare": (("job=report",), "report.runs=[RUN,RUN]"),
    "more processes than cores": (("job=train", *SMALL, "trainer.devices=999"), "than this machine has cores"),
    "no key for other machines": (
        ("job=deploy", "deploy=server", "deploy.host=0.0.0.0"),
        "set the environment variable",
    ),
    "another world's key": (("checkpoint=x", "task.hand_size=0.3"), "+task.hand_size=VALUE adds it"),
    "another world's expert": (("job=preview", "expert=metaworld"), "expert=metaworld acts in task=metaworld only"),
    "another world's goal": (("task=metaworld", "task/goal=lift"), "the option chosen for task has no goal"),
    "no environment": (("job=preview", "task=gymnasium"), "task.package is missing: the options chosen need"),
    "a config out of a pickle": (
        ("--experimental-rerun", "x.pickle"),
        "--experimental-rerun runs whatever a file says",
    ),
    "the same, abbreviated": (("--exp=x.pickle",), "--experimental-rerun runs whatever a file says"),
    "the store of all twice": (("job=train", "collect.folder=s", "collect.more=[a,./s]"), "name the same store, "),
    "no cells": (("-m", "seed=range(0,0)"), "the sweep has no cells: one of its ranges or choices is empty"),
    "brackets": ((f"seed={'[' * 200}{']' * 200}",), "nested too deep"),
    "no GPU": (("trainer=gpu", *(item for item in SMALL if "accelerator" not in item)), "gpu"),
}


@pytest.mark.parametrize("name", BAD_INPUT)
def test_bad_input_ends_in_one_clear_sentence(tmp_path: Path, name: str) -> None:
    arguments, says = BAD_INPUT[name]
    done = here(tmp_path, *arguments, ok=False)
    errors = [line for line in done.stderr.splitlines() if line.startswith("error: ")]
    assert len(errors) == 1 and says in errors[0], done.stderr
    assert "Traceback" not in done.stderr
    assert all([*run.iterdir()] for run in tmp_path.glob("outputs/runs/*"))  # none is left empty


# Job → values that no experiment can have, each of which is refused by the name of its key before any work.
NONSENSE = {
    "collect": (
        *(
            "task.time_limit=nan",
            "task.time_limit=inf",
            "task.time_limit=1e300",
            "task.goal.radius=nan",
            "task.image_size=[1,1]",
        ),
        *("task.image_size=[4096,4096]", "task.cameras=[front,front]", "task.randomize.mass.factor=[nan,nan]"),
        *("task.randomize.mass.factor=[0,0]", "task.randomize.mass.factor=[2,1]", "task.randomize.camera.fovy=500"),
        *("task.randomize.size.half_size=[0,0]", "task.randomize.size.half_size=[10,10]"),
        *("task.randomize.arm.x=[5,5]", "task.goal.language.phrasings=[]", "expert.perturb.rate=nan"),
        *("expert.perturb.rate=-1", "expert.perturb.noise=1e9", "expert.perturb.steps=[5,2]", "collect.folder="),
        *("collect.seed=-1", "cluster.workers=0", "collect.episodes=99999999999"),
    ),
    "train": (
        *("seed=99999999999999999999", "data.seed=-1", "data.validation_fraction=1.5", "model.chunk=0"),
        *("model.chunk=-1", "model.width=-1", "model.width=0", "model.width=10000000", "model.keypoints=0"),
        *("model.text_width=0", "model.shift=[-1,-1]", "model.auxiliary=nan", "model.auxiliary=-1"),
        *("model.image.strides=[0,1,1]", "model.image.kernels=[0,0,0]", "model.image.kernels=[99,99,99]"),
        *("model.text.vocabulary=1", "model.text.words=0", "model.text.word_dropout=1", "model.text.dropout=1"),
        *(
            "model.image.channels=[]",
            "tokenizer.bins=1",
            "tokenizer.smoothing=-1",
            "tokenizer.margin=-5",
            "tokenizer.bins=1000000",
        ),
        *(
            "learner.lr=0",
            "learner.weight_decay=-1",
            "learner.ema=1",
            "learner.ema=nan",
            "learner.warmup_steps=-1",
            "trainer.max_steps=0",
            "data.batch_size=0",
        ),
        *("trainer.val_check_interval=0", "trainer.accumulate_grad_batches=0", "trainer.devices=-7"),
        *(
            "trainer.val_check_interval=0.5",
            "trainer.val_check_interval=null",
            "trainer.max_epochs=3",
            "trainer.max_epochs=null",
        ),
        *("trainer.devices=abc", "trainer.devices='1,x'"),
        *(
            "trainer.gradient_clip_val=-1",
            "trainer.limit_val_batches=-1",
            "+trainer.limit_train_batches=0",
            "trainer.precision=17",
        ),
    ),
    "evaluate": ("evaluate.episodes=0", "evaluate.seed=3", "policy.precision=16"),
    "benchmark": (
        "benchmark.names=[]",
        "benchmark.names=[training]",
        "benchmark.precisions=[fp16]",
        "benchmark.rounds=0",
    ),
    "inspect": ("inspect.stores=[]", "inspect.folder="),
    "export": ("export.folder=",),
    "report": ("report.runs=['']",),
}


@pytest.mark.parametrize(("job", "override"), [(job, override) for job in NONSENSE for override in NONSENSE[job]])
def test_nonsense_is_refused_by_the_name_of_its_key(job: str, override: str) -> None:
    key = override.partition("=")[0].lstrip("+")
    with pytest.raises(ValueError, match=rf"^{re.escape(key)}(\[\d\])? must "):
        check(composed(f"job={job}", override))


@pytest.mark.parametrize(
    "phrasing", ["{nope} it", "take the {", "take {block.__class__}", "take {0}", "{block:>99999}"]
)
def test_a_phrasing_that_is_no_phrasing_is_refused(phrasing: str) -> None:
    cfg = composed()
    cfg.task.goal.language.phrasings = [phrasing]
    with pytest.raises(ValueError, match=r"^task\.goal\.language"):
        build(plain(cfg.task), "task")


def test_a_grid_whose_cells_want_several_processes_is_refused(tmp_path: Path) -> None:
    several = ("trainer=ddp", "trainer.accelerator=cpu", "trainer.devices=2", "seed=0")
    done = here(tmp_path, "-m", *several, ok=False)
    assert "trainer.devices=1" in done.stderr and "submitit_slurm" in done.stderr and "Traceback" not in done.stderr


def test_a_job_that_takes_no_checkpoint_says_which_word_does(tmp_path: Path) -> None:
    done = here(tmp_path, "job=train", "checkpoint=x", ok=False)
    assert "job=train takes no checkpoint: resume=RUN continues a run, pretrained=x starts" in done.stderr


@pytest.mark.parametrize(
    ("line", "sentence"),
    [
        ("experiment=recipe", "experiment=recipe is a grid of runs: add -m"),
        ("-m experiment=ablation,recipe", "experiment=ablation is a grid of its own: name no other one beside it"),
        ("-m seed=0,1 output=there", "every cell has a folder of its own: name that of the sweep, hydra.sweep.dir=DIR"),
        (
            "-m experiment=ablation variant=no_transformer model=rt1_small seed=0",
            "variant=no_transformer is model=bc: omit model=rt1_small",
        ),
        ("experiment=standard task=metaworld", "the option chosen for task has no randomize: choose another task"),
        ("task.image_size.height=64", "height"),
        ("checkpoint=x output=2", "output=2 is not a path"),
    ],
)
def test_a_line_that_would_not_do_what_it_says_is_refused(tmp_path: Path, line: str, sentence: str) -> None:
    done = here(tmp_path, *line.split(), ok=False)
    assert sentence in done.stderr and "Traceback" not in done.stderr


def test_an_experiment_may_have_options_of_another_job() -> None:
    check(composed("experiment=few_improved", "job=collect"))


def test_without_gl_the_error_says_what_to_install(tmp_path: Path) -> None:
    environment = {**os.environ, "MUJOCO_GL": "egl", "__EGL_VENDOR_LIBRARY_FILENAMES": "/nowhere.json"}
    for name in (WORKING_BACKEND, "DISPLAY"):
        environment.pop(name, None)
    done = subprocess.run(
        [sys.executable, "-m", "vla.run", "job=preview", "preview.episodes=1"],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 1 and "libegl1" in done.stderr and "Traceback" not in done.stderr


@pytest.mark.parametrize("name", ["RANK", "LOCAL_RANK", "SLURM_STEP_NUM_TASKS"])
def test_a_rank_that_is_no_number_is_named(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(name, "x")
    done = here(tmp_path, "resume=last", "output=nowhere/now", ok=False)
    assert done.stderr == f"error: the environment variable {name} must be a number of a launcher, got 'x': unset it\n"
