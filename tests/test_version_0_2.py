"""Files that version 0.2 wrote load as before, and its runs resume exactly.

`fixtures/version_0_2` holds a run of the quick-start recipe in tiny widths: its `config.yaml`, the checkpoint of step
2, the weights of the denoiser after step 4, and a student of the trained model. Long lists of captions and words in
them are shortened.
"""

import io
import lzma
from pathlib import Path
from typing import Any

import pytest
import torch

import flame_mdm
from flame_mdm.__main__ import main
from flame_mdm.checkpoints.loading import load_task
from flame_mdm.checkpoints.model_files import read_checkpoint
from flame_mdm.config import read_saved, renamed
from flame_mdm.errors import UserError
from flame_mdm.generator import DistilledGenerator, MotionGenerator
from flame_mdm.sampler_options import SamplerOptions
from flame_mdm.task import GeneratorTask
from flame_mdm.training.adaptation import AdaptationTask
from flame_mdm.training.distillation import DistillationTask

FILES = Path(__file__).parent / "fixtures" / "version_0_2"
OLD_TASK = "flame_mdm.task.MotionGeneration"


def content(name: str) -> bytes:
    return lzma.decompress((FILES / f"{name}.xz").read_bytes())


def tensors(name: str) -> dict[str, Any]:
    return torch.load(io.BytesIO(content(name)), weights_only=True)


@pytest.fixture
def checkpoint(tmp_path) -> Path:
    """The checkpoint of step 2, as the run wrote it."""
    path = tmp_path / "last.ckpt"
    path.write_bytes(content("step_2.ckpt"))
    return path


def test_a_checkpoint_loads_with_its_averaged_weights_under_the_same_names(checkpoint, subtests):
    saved = torch.load(checkpoint, weights_only=True)
    assert saved["config"]["task"]["_target_"] == OLD_TASK
    for kind in (MotionGenerator, GeneratorTask):
        with subtests.test(kind=kind):
            model = load_task(checkpoint, kind)
            assert type(model) is kind
            assert (model.steps, model.facts) == (2, saved["facts"])
            state = model.state_dict()
            assert list(state) == list(saved["state_dict"])
            assert all(
                torch.equal(value, saved["state_dict"][name]) for name, value in state.items()
            )
            assert model.config["task"] == saved["config"]["task"] | {
                "_target_": "flame_mdm.task.GeneratorTask"
            }
    (motion,) = flame_mdm.generate(
        flame_mdm.load(checkpoint), saved["facts"]["captions"][0], frames=20
    )
    assert motion.joints.shape == (20, 22, 3)


@pytest.mark.slow
def test_a_run_resumes_exactly(checkpoint, data_root, tmp_path, subtests):
    run = tmp_path / "run"
    (run / "checkpoints").mkdir(parents=True)
    config = (FILES / "config.yaml").read_text()
    (run / "config.yaml").write_text(config.replace("  dir: run\n", f"  dir: {run}\n"))
    saved = torch.load(checkpoint, weights_only=True)
    saved["facts"]["fingerprint"] = (
        None  # of the same clips, which a later version may store in another format
    )
    torch.save(saved, run / "checkpoints" / "last.ckpt")
    words = [f"run.dir={run}", f"data_root={data_root}", f"data.root={data_root}"]
    assert main(["train", str(run / "config.yaml"), *words]) == 0
    expected, resumed = tensors("step_4.pt"), read_checkpoint(run / "checkpoints" / "last.ckpt")
    assert resumed["global_step"] == 4
    for name, part in (("weights", "current_model_state"), ("average", "state_dict")):
        with subtests.test(name=name):
            weights = {key: resumed[part][key] for key in expected[name]}
            # The learning rate is 2e-3. Weights whose gradients are close to zero differ by up to 6e-5
            # between processors, as Adam divides by the size of the gradient.
            torch.testing.assert_close(weights, expected[name], rtol=0, atol=1e-4)


def test_a_student_loads_without_its_teacher_and_is_written_again(tmp_path):
    file = tmp_path / "student.safetensors"
    file.write_bytes(content("student.safetensors"))
    model = flame_mdm.load(file)
    assert type(model) is DistilledGenerator
    assert type(load_task(file, GeneratorTask)) is DistillationTask
    assert "trajectory" not in model.process.edit_modes
    with pytest.raises(UserError, match="the guidance is built into this distilled model"):
        flame_mdm.generate(model, model.facts["captions"][0], guidance_scale=2)
    model.check_request(None, unconditioned=False)
    model.check_request(SamplerOptions(guidance_scale=1.0), unconditioned=False)
    with pytest.raises(UserError, match="trained only with conditions"):
        model.check_request(None, unconditioned=True)
    assert main(["export", str(file), str(tmp_path / "again.safetensors")]) == 0
    again = flame_mdm.load(tmp_path / "again.safetensors")
    torch.testing.assert_close(again.state_dict(), model.state_dict(), rtol=0, atol=0)


def test_the_task_of_a_configuration_gets_its_name_of_today(tmp_path):
    (tmp_path / "config.yaml").write_bytes((FILES / "config.yaml").read_bytes())
    assert (
        read_saved(tmp_path / "config.yaml")["task"]["_target_"] == "flame_mdm.task.GeneratorTask"
    )
    adaptation = renamed({"task": {"_target_": OLD_TASK}, "base": "runs/base"})
    assert (
        adaptation["task"]["_target_"] == f"{AdaptationTask.__module__}.{AdaptationTask.__name__}"
    )
    other: dict[str, Any] = {"task": {"_target_": "my.Task"}, "base": "runs/base"}
    assert renamed(other) == other
    assert renamed({"data": {}}) == {"data": {}}
