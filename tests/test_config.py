import subprocess
import sys
import textwrap
from pathlib import Path

import pytest
import torch

from flame_mdm import config
from flame_mdm.__main__ import main
from flame_mdm.config import check, command_line, compose, flatten, instantiate, parameters, recipes, trust
from flame_mdm.errors import UserError
from flame_mdm.safe_io import read_yaml


@pytest.mark.parametrize("name", recipes())
def test_every_recipe_composes_and_is_legal(name):
    composed = compose(name)
    assert composed["experiment"] == name
    assert {"data", "representation", "task", "trainer"} <= composed.keys()


@pytest.mark.parametrize("name", recipes())
def test_recipes_are_short_and_say_what_they_are(name):
    lines = (config.EXPERIMENTS / f"{name}.yaml").read_text().splitlines()
    assert len(lines) <= 25
    assert lines[0] == "# @package _global_"
    assert lines[1].startswith("# ")


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["trainer.max_step=5"], "unknown config key 'trainer.max_step'. Did you mean trainer.max_steps"),
        (["max_steps=5"], "unknown config key 'max_steps'. Did you mean trainer.max_steps?"),
        (["optimizer.weigth_decay=0.1"], "Did you mean optimizer.weight_decay?"),
        (["denoiser=mdm_encodr"], "no denoiser is called 'mdm_encodr'. Did you mean mdm_encoder"),
        (["denoiser.latent_dims=3"], "Did you mean denoiser.latent_dim?"),
        (["data.source.clip=3"], "Did you mean data.source.clips"),
        (["nonsense"], "cannot read an override"),
        (["trainer.max_steps=[1"], "cannot read an override"),
        (["+denoiser.heads=3"], "unknown config key 'denoiser.heads'. Did you mean denoiser.num_heads?"),
        (["denoiser._target_=flame_mdm.denoisers.mdm.Encoder"], "no such class or function"),
    ],
)
def test_a_wrong_override_is_one_line_with_the_nearest_names(overrides, message):
    with pytest.raises(UserError) as error:
        compose("quickstart", overrides)
    assert message in str(error.value)
    assert "\n" not in str(error.value)


def test_an_unknown_experiment_names_the_nearest():
    with pytest.raises(UserError, match=r"unknown experiment 'quikstart'\. Did you mean quickstart"):
        compose("quikstart")


def test_a_key_that_only_the_signature_knows_is_legal():
    assert compose("quickstart", ["trainer.limit_val_batches=2"])["trainer"]["limit_val_batches"] == 2


def test_swapping_a_part_leaves_nothing_of_the_old_one():
    swapped = compose("quickstart", ["denoiser=mdm_encoder", "representation=humanml_legacy"])
    assert swapped["denoiser"]["latent_dim"] == 512
    assert swapped["representation"]["variant"] == "legacy"


def test_a_saved_configuration_composes_to_itself_and_its_parts_are_fixed(tmp_path):
    composed = compose("quickstart", ["seed=3"])
    config.save(composed, tmp_path / "config.yaml", head="a run")
    assert compose(str(tmp_path / "config.yaml")) == composed
    assert compose(str(tmp_path / "config.yaml"), ["optimizer.lr=1.0"])["optimizer"]["lr"] == 1.0
    with pytest.raises(UserError, match="denoiser=mdm_encoder replaces a part of a recipe"):
        compose(str(tmp_path / "config.yaml"), ["denoiser=mdm_encoder"])


def test_a_recipe_outside_the_repository_uses_its_parts(tmp_path):
    recipe = "# @package _global_\n# Mine.\ndefaults:\n  - /quickstart\n  - _self_\nseed: 5\n"
    (tmp_path / "mine.yaml").write_text(recipe)
    composed = compose(str(tmp_path / "mine.yaml"))
    assert (composed["seed"], composed["experiment"]) == (5, "mine")


def test_a_damaged_yaml_is_one_line(tmp_path):
    (tmp_path / "bad.yaml").write_text("a: [1\nb: {")
    with pytest.raises(UserError, match=r"bad\.yaml: not a readable YAML file") as error:
        compose(str(tmp_path / "bad.yaml"))
    assert "\n" not in str(error.value)
    with pytest.raises(UserError, match="no such file"):
        compose(str(tmp_path / "absent.yaml"))


def test_signatures_are_read_through_reexports_bases_and_dataclasses():
    assert {"lr", "weight_decay", "fused"} <= parameters("torch.optim.AdamW")
    assert {"max_steps", "devices"} <= parameters("lightning.Trainer")
    assert {"monitor", "save_top_k"} <= parameters("lightning.pytorch.callbacks.ModelCheckpoint")
    assert {"keep", "known", "mode"} <= parameters("flame_mdm.batch.Edit")
    with pytest.raises(UserError, match="no such class"):
        parameters("torch.optim.Adamm")


def test_check_finds_unknown_arguments_deep_inside():
    with pytest.raises(UserError, match=r"unknown config key 'a\.0\.lrr'\. Did you mean a\.0\.lr\?"):
        check({"a": [{"_target_": "torch.optim.AdamW", "lrr": 1}]})


def test_untrusted_targets_are_refused(monkeypatch):
    with pytest.raises(UserError, match=r"os\.system at b\. Its code is only run if you trust it"):
        trust({"_target_": "flame_mdm.denoisers.mdm.MDMEncoder", "b": {"_target_": "os.system"}})
    monkeypatch.setenv("FLAME_MDM_TRUST", "fractions")
    trust({"_target_": "fractions.Fraction", "numerator": 3})


@pytest.mark.parametrize(
    "target",
    [
        *("os.system", "builtins.eval", "subprocess.Popen", "torch.load", "torch.hub.load", "torch.nn.Identity"),
        "torch.utils.collect_env.run",
        "lightning.pytorch.Trainer",
        "flame_mdm.config.run",  # a function
        "flame_mdm.data.restricted_pickle.read",
        "flame_mdm.data.store.shutil.rmtree",  # what a trusted module imports
        "flame_mdm.data.store.Path",
        "flame_mdm.task.torch.load",
        "flame_mdm.denoisers.mdm",
        "flame_mdm.training.callbacks.Checkpoints",  # writes files
        "evaluators",
        "evaluators.",
        ".system",
        "",
        "${oc.decode:os.system}",
        eval,
        None,
    ],
)
def test_a_checkpoint_names_only_own_classes(target, monkeypatch):
    monkeypatch.setenv("FLAME_MDM_TRUST", ",")
    for hidden in (
        {"_target_": target},
        {"a": [1, {"b": ({"_target_": target},)}]},  # a tuple, which Hydra takes as a list
        {"_target_": "flame_mdm.task.MotionGeneration", "_args_": [{"_partial_": True, "_target_": target}]},
    ):
        with pytest.raises(UserError, match="Its code is only run if you"):
            trust({"denoiser": hidden})


@pytest.mark.slow
@pytest.mark.parametrize("name", recipes())
def test_what_checkpoints_of_our_recipes_name_is_trusted(name):
    composed = compose(name)
    parts = ("task", "representation", "process", "condition", "denoiser", "data")
    trust({part: composed[part] for part in parts if part in composed})


def test_wrong_arguments_are_one_line():
    with pytest.raises(UserError) as error:
        instantiate({"_target_": "torch.nn.Linear", "in_features": "a", "out_features": []})
    assert "\n" not in str(error.value)


def test_flatten():
    assert flatten({"a": {"b": 1, "c": [2]}, "d": {}}) == {"a.b": 1, "a.c": [2], "d": {}}


def test_what_make_hands_down_is_read_without_a_shell(monkeypatch):
    flags = r"""s -- q=#hash UNCONDITIONED=1 TEXT=100%\ a\ --\ b\ $$5 x.y=a\ "c"\ (d)\ ;$$HOME a.b=[1,\ 2] EXP=q"""
    monkeypatch.setenv("MAKEFLAGS", flags)
    words = ["q", "a.b=[1, 2]", 'x.y=a "c" (d) ;$HOME', "text=100% a -- b $5", "unconditioned=1", "q=#hash"]
    assert command_line._make_variables() == words
    monkeypatch.setenv("MAKEFLAGS", "")
    assert command_line._make_variables() == []


@pytest.mark.parametrize("text", ["it's ${a} (b), c=d; \\ [e]", "plain", '"quoted" ünïcode'])
def test_free_text_survives_hydra(text, capsys):
    seen = {}
    code = config.run(seen.update, [f"text={text}"], usage="", name="sample", text=("text",))
    assert (code, seen["text"]) == (0, text)


def test_help_and_a_misspelt_key_do_not_wait_for_torch():
    program = """
        import sys
        from flame_mdm.__main__ import main
        assert main(["train", "--help"]) == 0
        assert main(["train", "quickstart", "trainer.max_step=1"]) == 1
        assert main(["sample", "text=a"]) == 1
        assert main(["prepare"]) == 1
        assert "torch" not in sys.modules and "lightning" not in sys.modules, "heavy imports"
    """
    result = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(program)], capture_output=True, text=True, check=False
    )
    assert result.returncode == 0, result.stderr
    assert result.stderr.count("error: ") == 3


def test_own_classes_outside_the_repository_need_no_registration(tmp_path, monkeypatch):
    module = (
        "import torch\nclass Mine(torch.nn.Module):\n    def __init__(self, width: int):\n        super().__init__()\n"
    )
    (tmp_path / "my_parts.py").write_text(module)
    monkeypatch.syspath_prepend(tmp_path)
    assert isinstance(instantiate({"_target_": "my_parts.Mine", "width": 3}), torch.nn.Module)
    with pytest.raises(UserError, match="Did you mean width"):
        check({"_target_": "my_parts.Mine", "widht": 3})


def test_the_experiments_folder_is_found():
    assert (Path(config.EXPERIMENTS) / "base.yaml").is_file()


def test_an_unknown_command_is_one_line(capsys):
    assert main(["trian"]) == 1
    assert capsys.readouterr().err == (
        "error: unknown command: trian. Did you mean train? `flame-mdm --help` lists the commands\n"
    )


def test_no_key_of_a_command_is_the_name_of_a_folder_of_recipes():
    """Hydra would take `folder=x` for a choice among the files of `experiments/folder`."""
    folders = {path.name for path in config.EXPERIMENTS.iterdir() if path.is_dir()}
    for path in config.EXPERIMENTS.glob("*.yaml"):
        assert not folders & set(read_yaml(path)), path.name
