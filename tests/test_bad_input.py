"""What the user can mend, at the command line: one sentence for each way to it, before any work."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import toy
from command_line import SMALL, here, vla
from composing import check, composed

from vla.config.build import build
from vla.config.experiment import to_plain
from vla.data.episodes import EpisodeStore
from vla.tasks.gl import WORKING_BACKEND

# Line → what its sentence says.
BAD_INPUT = {
    "colect.episodes=3": "there is no colect, did you mean collect?",
    "model=rt2": "model has no option 'rt2', did you mean rt1?",
    "trainer.max_steps=many": "trainer.max_steps must be ",
    "checkpoint=nowhere": "there is no policy 'nowhere': name a run",
    "checkpoint=nowhere.ckpt": "serves only to resume its own training: name the folder of the run",
    "job=deploy": "job=deploy needs deploy=OPTION",
    "job=report": "report.runs=[RUN,RUN]",
    "job=deploy deploy=loop": "this deployment needs a trained policy",
    "resume=true": "resume=True is not a path",
    "checkpoint=3": "checkpoint=3 is not a path",
    "checkpoint=x output=2": "output=2 is not a path",
    "job=train checkpoint=x": "job=train takes no checkpoint: omit it, or train with resume=RUN",
    "resume=last output=nowhere/now": "resume=last: nothing was trained in nowhere",
    "job=preview task.blocks=4 task.randomize.placement.x=[0.5,0.5]": "no room",
    "job=train collect.more=[lessons] collect.folder=store": "lessons",
    f"job=train {' '.join(SMALL)} trainer.devices=999": "than this machine has cores",
    "job=deploy deploy=server deploy.host=0.0.0.0": "set the environment variable",
    "checkpoint=x task.hand_size=0.3": "+task.hand_size=VALUE adds it",
    "job=preview expert=metaworld": "expert=metaworld acts in task=metaworld only",
    "task=metaworld task/goal=lift": "the chosen options have no group 'task/goal': +task/goal=OPTION adds it",
    "experiment=standard task=metaworld": "the chosen options have no group 'task/randomize'",
    "job=preview task=gymnasium": "task.package",
    "task.image_size.height=64": "'height' is no item of a list: these have numbers, from 0",
    "--experimental-rerun x.pickle": "--experimental-rerun runs whatever a file says",
    "--exp=x.pickle": "--experimental-rerun runs whatever a file says",
    "--task=recorded": "--task is no option: write task=recorded, without dashes",
    "-m seed=0,1 --cfg job": "--cfg shows the config of one run: leave out -m",
    "+experiment=standard": "experiment has an option already, which experiment=OPTION replaces: leave out the +",
    "+model=bc": "comes from two options of one group: leave out the +",
    "logger=null": "logger=null: logger takes the name of an option, as in logger=none, see --help",
    "-m logger=tensorboard,null": "logger takes the name of an option, as in logger=none",
    "model/image/pretrained=false": "see --help; a value has dots, model.image.pretrained=false",
    "~job": "~job leaves no job: choose another one, job=OPTION",
    "experiment=[standard,few]": "experiment=[standard,few] names several: experiment takes one option",
    "=3": "=3 has no key: write KEY=3",
    "agent=remote agent.api_key=x": "agent.api_key: Hydra would save the api_key in the folder of the run: set the env",
    "task.image_size=[96]": "task.image_size must be longer, got [96]",
    "improve.rounds=3": "there is no improve without job=improve",
    "deploy=server checkpoint=x": "deploy=OPTION goes with job=deploy: add that",
    "task.randomize.latency.seconds=[0,0.1]": "before task/randomize/latency is chosen: add task/randomize/latency=",
    "job=inspect inspect.seed=0": "there is no inspect.seed: there are folder, stores, where",
    "--resolve": "--resolve goes with --cfg job",
    "task.goal=lift": "got 'lift': an option is chosen with a slash, task/goal=lift",
    "-m seed=range(0,0)": "the sweep has no cells: one of its ranges or choices is empty",
    "-m trainer=ddp trainer.accelerator=cpu trainer.devices=2 seed=0": "add trainer.devices=1, or hydra/launcher=sub",
    "-m experiment=ablation,recipe": "experiment=ablation is a grid of its own: run it without other experiments",
    "-m seed=0,1 output=there": "output=there would be every cell's folder: name the sweep's, hydra.sweep.dir=DIR",
    "-m seed=0,1 ++output=there": "output=there would be every cell's folder",
    "-m job=plan hydra.sweep.subdir=${seed}/x": "a sweep's table needs a single name for each cell",
    "-m job=plan hydra.output_subdir=null": "1 of 1 cells failed",
    "job=plan -m plan.rates=[0.5,0.5]": "are equal: no number of episodes tells them apart",
    "-m plan seed=0,1": "cannot read plan",
    "-m experiment=ablation variant=no_transformer model=rt1_small seed=0": "sets model=bc: omit model=rt1_small",
    "experiment=recipe": "experiment=recipe is a grid of runs: add -m",
    f"seed={'[' * 200}{']' * 200}": "nested too deep",
    f"trainer.accelerator=gpu {' '.join(item for item in SMALL if 'accelerator' not in item)}": "gpu",
}


@pytest.mark.parametrize("line", BAD_INPUT)
def test_bad_input_ends_in_one_clear_sentence(tmp_path: Path, line: str) -> None:
    done = here(tmp_path, *line.split(), ok=False)
    assert done.stderr.count("error: ") == 1 and BAD_INPUT[line] in done.stderr and "Traceback" not in done.stderr
    assert not [*tmp_path.glob("outputs/runs/*")]  # nothing was done


def test_a_number_in_a_file_that_is_none_is_told_with_the_file(tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "run/metrics.csv").write_text("step,loss\n1.5,1\n")
    done = here(tmp_path, "job=report", "report.runs=[run]", ok=False)
    assert "run/metrics.csv is damaged in line 2" in done.stderr


@pytest.mark.parametrize("job", ["train", "improve"])
def test_a_further_store_of_another_world_is_refused_before_anything_is_collected(tmp_path: Path, job: str) -> None:
    EpisodeStore.create_or_open(tmp_path / "further", toy.SPEC, {})
    further = ("collect.more=[further]", "collect.folder=store", "output=run", "hydra.run.dir=run")
    done = here(tmp_path, *SMALL, f"job={job}", *further, ok=False)
    assert "error: the model has cameras = " in done.stderr and not (tmp_path / "store").exists()


# Job → values that no experiment can have, each of which is refused by the name of its key before any work.
NONSENSE = {
    "collect": """
        task.time_limit=nan task.time_limit=inf task.time_limit=1e300 task.goal.radius=nan task.image_size=[1,1]
        task.image_size=[4096,4096] task.cameras=[front,front] task.randomize.mass.factor=[nan,nan]
        task.randomize.mass.factor=[0,0] task.randomize.mass.factor=[2,1] task.randomize.camera.fovy=500
        task.randomize.size.half_size=[0,0] task.randomize.size.half_size=[10,10] task.randomize.arm.x=[5,5]
        task.goal.language.phrasings=[] expert.perturb.rate=nan expert.perturb.rate=-1 expert.perturb.noise=1e9
        expert.perturb.steps=[5,2] collect.folder= collect.seed=-1 cluster.workers=0 collect.episodes=99999999999
        collect.images=png collect.quality=96
    """,
    "train": """
        seed=99999999999999999999 data.seed=-1 data.validation_fraction=1.5 model.chunk=0 model.chunk=-1
        model.width=-1 model.width=0 model.width=10000000 model.keypoints=0 model.text_width=0 model.shift=[-1,-1]
        model.auxiliary=nan model.auxiliary=-1 model.image.strides=[0,1,1] model.image.kernels=[0,0,0]
        model.image.kernels=[99,99,99] model.text.vocabulary=1 model.text.words=0 model.text.word_dropout=1
        model.text.dropout=1 model.image.channels=[] tokenizer.bins=1 tokenizer.smoothing=-1 tokenizer.margin=-5
        tokenizer.bins=1000000 learner.lr=0 learner.weight_decay=-1 learner.ema=1 learner.ema=nan
        learner.warmup_steps=-1 trainer.max_steps=0 data.batch_size=0 trainer.val_check_interval=0
        trainer.accumulate_grad_batches=0 trainer.devices=-7 trainer.val_check_interval=0.5
        trainer.val_check_interval=null trainer.max_epochs=3 trainer.max_epochs=null trainer.devices=abc
        trainer.devices='1,x' trainer.gradient_clip_val=-1 trainer.limit_val_batches=-1 +trainer.limit_train_batches=0
        trainer.check_val_every_n_epoch=0 trainer.check_val_every_n_epoch=2 trainer.precision=17
        model.text.words=2147483647
    """,
    "evaluate": """
        evaluate.episodes=0 evaluate.seed=3 policy.precision=16
    """,
    "benchmark": """
        benchmark.names=[] benchmark.names=[training] benchmark.precisions=[fp16] benchmark.compile=[]
    """,
    "inspect": """
        inspect.stores=[] inspect.folder=
    """,
    "export": """
        export.folder=
    """,
    "report": """
        report.runs=['']
    """,
}


@pytest.mark.parametrize(("job", "override"), [(job, each) for job, line in NONSENSE.items() for each in line.split()])
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
        build(to_plain(cfg.task), "task")


def test_an_experiment_may_have_options_of_another_job() -> None:
    check(composed("experiment=few_improved", "job=collect"))


def test_without_gl_the_error_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MUJOCO_GL", "egl")
    monkeypatch.setenv("__EGL_VENDOR_LIBRARY_FILENAMES", "/nowhere.json")
    for name in (WORKING_BACKEND, "DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    done = vla(tmp_path, "job=preview", "preview.episodes=1", ok=False)
    assert done.returncode == 1 and "libegl1" in done.stderr and "Traceback" not in done.stderr


@pytest.mark.parametrize("value", ["", "x", "-1"])
def test_a_rank_that_is_no_number_is_named(tmp_path: Path, value: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SLURM_PROCID", value)
    done = here(tmp_path, "job=report", ok=False)
    assert f"error: the environment variable SLURM_PROCID is '{value}', not the number" in done.stderr
