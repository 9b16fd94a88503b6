"""Motion-CLIP: the authors' numbers, the contrast over several processes, and training by recipe."""

import json
import math
import re
from itertools import islice
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from support.fixtures import GOLDEN, assert_within, golden, golden_case, meta, weights
from torch.nn import functional

from evaluators.extractors import MotionCLIPExtractor
from evaluators.extractors.motion_clip import (
    MotionCLIP,
    MotionCLIPTask,
    PooledLoss,
    info_nce,
    our_names,
)
from evaluators.extractors.motion_clip_calibrated import (
    CalibratedMotionCLIPTask,
    calibration_error,
    noisy_copies,
)
from flame_mdm.__main__ import main
from flame_mdm.batch import MotionBatch, length_mask
from flame_mdm.checkpoints.hub import export
from flame_mdm.checkpoints.loading import load, load_task
from flame_mdm.checkpoints.model_files import read_checkpoint
from flame_mdm.checkpoints.released_weights import load_strictly
from flame_mdm.conditions.text import PretrainedText
from flame_mdm.config import compose, instantiate
from flame_mdm.data.store import Entry
from flame_mdm.data.synthetic import Synthetic
from flame_mdm.errors import UserError
from flame_mdm.representations.humanml import HumanML
from flame_mdm.representations.smpl import SMPL
from flame_mdm.runs import read_history

SMALL = {
    "latent_dim": 16,
    "ff_size": 24,
    "num_layers": 2,
    "num_heads": 4,
    "embedding_dim": 8,
    "max_frames": 20,
}


def network(in_features: int = 7, **options) -> MotionCLIP:
    torch.manual_seed(0)
    return MotionCLIP(in_features, 10, dropout=0.0, **SMALL, **options).eval()


@golden_case("flame_mclip")
def test_released_weights_give_the_authors_outputs(stem):
    arrays = golden(stem)
    state = our_names(weights(arrays) | {"text_model.encoder.weight": torch.zeros(1)})
    (embedding, texts), (width, features) = (
        state["text_projection.weight"].shape,
        state["input.weight"].shape,
    )
    sizes: dict[str, Any] = {
        "latent_dim": width,
        "ff_size": len(state["transformer.layers.0.feed_forward.0.weight"]),
    }
    sizes["num_layers"] = len(
        {name.split(".")[2] for name in state if name.startswith("transformer.layers.")}
    )
    sizes |= {
        "num_heads": meta(arrays)["config"]["heads"],
        "max_frames": len(state["length_embedding.weight"]),
    }
    clip = MotionCLIP(
        features, texts, dropout=0.1, embedding_dim=embedding, blind_features=3, **sizes
    )  # type: ignore[arg-type]
    load_strictly(clip, state, stem)
    x = torch.from_numpy(arrays["in/motion"]).transpose(1, 2)
    mask = length_mask(torch.from_numpy(arrays["in/motion_length"]), x.shape[1])
    with torch.no_grad():
        motion, text = clip(x, mask), clip.text(torch.from_numpy(arrays["lm/pooler_output"]))
        unit_motion, unit_text = (
            functional.normalize(motion, dim=1),
            functional.normalize(text, dim=1),
        )
        logits = clip.logit_scale.exp() * unit_motion @ unit_text.T
        ours = {
            "motion_feat": motion,
            "motion_feat_shifted_translation": clip(x + torch.arange(x.shape[2]).lt(3) * 5.0, mask),
            "text_feat": text,
            "motion_feat_l2_norm": unit_motion,
            "text_feat_l2_norm": unit_text,
            "logits_per_motion": logits,
            "logits_per_text": logits.T,
            "loss": info_nce(motion, text, clip.logit_scale),
        }
    for name, value in ours.items():
        assert_within(value, arrays, f"out/{name}")
    # The temperature starts where the authors start it.
    assert network().logit_scale.item() == pytest.approx(
        float(arrays["state_init/logit_scale"]), abs=1e-6
    )
    assert network().logit_scale.item() == pytest.approx(math.log(1 / 0.07))


def released() -> dict[str, torch.Tensor]:
    """Random weights by the names and sizes of the released file."""
    manifest = json.loads((GOLDEN / "state_dict_manifest.json").read_text())["flame_mclip_net"]
    torch.manual_seed(0)
    shapes = {
        name: shape
        for name, shape in manifest["keys"].items()
        if not name.startswith("text_model.")
    }
    shapes |= {"text_model.pooler.dense.weight": [768, 768], "text_model.pooler.dense.bias": [768]}
    state = {name: 0.05 * torch.randn(shape) for name, shape in shapes.items()}
    return state | {"text_model.embeddings.word_embeddings.weight": torch.randn(5, 768)}


@golden_case("state_dict_manifest-flame_mclip_net")
def test_the_recipe_takes_every_weight_of_the_released_network(stem):
    recipe = compose("motion_clip/humanml3d_smpl")["task"]["network"]
    ours, state = instantiate(recipe, in_features=147, text_features=768), released()
    load_strictly(ours, our_names(state), "released")
    assert (
        ours.blind_features,
        ours.transformer.layers[0].self_attention.num_heads,
        recipe["dropout"],
    ) == (3, 8, 0.1)
    with pytest.raises(UserError, match="released"):
        load_strictly(
            ours,
            our_names({k: v for k, v in state.items() if k != "lm_projection.bias"}),
            "released",
        )
    with pytest.raises(ValueError, match="unknown keys extra"):
        our_names({**state, "extra": torch.zeros(1)})


@pytest.mark.slow
@pytest.mark.parametrize("stem", ["state_dict_manifest-flame_mclip_net"])
def test_the_released_file_becomes_an_extractor(stem, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("FLAME_MDM_DATA", str(tmp_path / "own"))
    file, out, state = tmp_path / "mclip.ckpt", tmp_path / "mclip.safetensors", released()
    torch.save(
        {"state_dict": {f"net.{name}": value for name, value in state.items()}, "epoch": 3}, file
    )
    with pytest.raises(UserError, match=r"mclip\.ckpt: not a checkpoint .* `flame-mdm import`"):
        MotionCLIPExtractor(str(file))
    assert main(["import", "mclip", str(file), f"out={out}"]) == 0, capsys.readouterr().err
    assert str(tmp_path).encode() not in out.read_bytes()
    extractor = MotionCLIPExtractor(str(out))
    for dataset in ("humanml3d", "babel"):
        extractor.check(SMPL(fps=20), dataset)
    with pytest.raises(UserError, match="trained on smpl"):
        extractor.check(instantiate(compose("kit/mdm")["representation"]), "kit")

    condition, clip = extractor.task.condition, extractor.task.network
    assert isinstance(condition, PretrainedText)
    assert torch.equal(condition.pooler_weight, state["text_model.pooler.dense.weight"])
    assert torch.equal(condition.pooler_bias, state["text_model.pooler.dense.bias"])
    assert all(
        torch.equal(value, clip.state_dict()[name]) for name, value in our_names(state).items()
    )

    torch.save(
        {
            "state_dict": {
                f"net.{k}": v for k, v in state.items() if k != "text_model.pooler.dense.bias"
            }
        },
        file,
    )
    assert main(["import", "mclip", str(file), f"out={out}"]) == 1
    assert re.search(
        r"mclip\.ckpt: .*not the weights of PretrainedText: .*pooler_bias", capsys.readouterr().err
    )


@pytest.mark.parametrize("roughness", [False, True])
def test_padding_and_company_do_not_change_features(roughness, subtests):
    clip, x, lengths = (
        network(roughness=roughness),
        torch.randn(3, 20, 7),
        torch.tensor([20, 13, 1]),
    )
    together = clip(x, length_mask(lengths))
    for row, length in enumerate(lengths.tolist()):
        with subtests.test(row=row):
            alone = clip(x[row : row + 1, :length], torch.ones(1, length, dtype=torch.bool))
            torch.testing.assert_close(alone[0], together[row], atol=1e-5, rtol=1e-5)
    # The batch is padded beyond the table of lengths.
    clip(torch.zeros(1, 25, 7), length_mask(torch.tensor([20]), 25))
    with pytest.raises(UserError, match=r"21 frames, but this motion-CLIP accepts at most 20"):
        clip(torch.zeros(1, 21, 7), length_mask(torch.tensor([21])))


def test_the_loss_with_hard_negatives_is_that_of_a_loop():
    generator = torch.Generator().manual_seed(5)
    motion, text = (
        functional.normalize(torch.randn(6, 8, generator=generator), dim=1) for _ in range(2)
    )
    meaning = torch.tensor([[1, 10], [2, 20], [3, 30], [1, 40], [4, 50], [5, 20]])
    wrong, scale = functional.normalize(torch.randn(6, 2, 8, generator=generator), dim=2), 7.0
    total = 0.0
    for i in range(6):
        others = [j for j in range(6) if not (meaning[i] == meaning[j]).any()]
        own = math.exp(scale * float(motion[i] @ text[i]))
        texts = [float(motion[i] @ text[j]) for j in others] + [
            float(motion[i] @ near) for near in wrong[i]
        ]
        motions = [float(text[i] @ motion[j]) for j in others]
        for negatives in (texts, motions):
            total -= (
                math.log(own / (own + sum(math.exp(scale * cosine) for cosine in negatives))) / 12
            )
    # Pairs 0 and 3 share the first number, 1 and 5 the second.
    loss = info_nce(
        2 * motion, text, torch.tensor(math.log(scale)), meaning=meaning, wrong_text=3 * wrong
    )
    assert loss.item() == pytest.approx(total, rel=1e-5)


def test_the_validation_loss_is_that_of_pools():
    """Pairs are given in disorder; the last 6 of 70 are compared with the last 32."""
    torch.manual_seed(0)
    motion, text, order, metric = (
        torch.randn(70, 8),
        torch.randn(70, 8),
        torch.randperm(70),
        PooledLoss(),
    )
    metric.update(motion[order], text[order], order, torch.tensor(5.0))
    terms = []
    for pool, new in ((slice(0, 32), 32), (slice(32, 64), 32), (slice(38, 70), 6)):
        logits, own = (5 * motion[pool] @ text[pool].T).double(), torch.arange(32)
        ways = [
            functional.cross_entropy(table, own, reduction="none")[-new:]
            for table in (logits, logits.T)
        ]
        terms.append((ways[0] + ways[1]) / 2)
    assert metric.compute() == pytest.approx(torch.cat(terms).mean().item(), rel=1e-6)


def test_roughness_alone_sees_noise_and_no_steady_change():
    clip = network(roughness=True)
    with torch.no_grad():  # nothing but the roughness reaches the transformer
        clip.input.weight[:, :7] = 0
    steady = torch.linspace(0, 3, 20)[:, None] * torch.randn(2, 1, 7)
    mask = torch.ones(2, 20, dtype=torch.bool)
    torch.testing.assert_close(clip(steady, mask), clip(0 * steady, mask), atol=1e-4, rtol=0)
    assert not torch.allclose(
        clip(steady + 0.1 * torch.randn(2, 20, 7), mask), clip(steady, mask), atol=1e-3
    )


def test_the_calibration_error_compares_distances_of_unit_vectors():
    x = torch.tensor([[2.0, 0], [0, 3], [1, 1]])
    y = torch.tensor([[5.0, 0], [1, 0], [-1, -1]])
    strength = torch.tensor([0.25, 2**0.5, 1.0])  # the distances are 0, sqrt(2) and 2
    assert calibration_error(x, y, strength).item() == pytest.approx((0.25 + 0 + 1) / 3)


def walks(count: int) -> list[torch.Tensor]:
    clips = (
        clip
        for clip in Synthetic(clips=60, seed=1).clips(20.0)
        if clip.attributes["action"] == "walk"
    )
    return [torch.from_numpy(clip.motion) for clip in islice(clips, count)]


def test_noisy_copies_have_noise_of_the_stated_strength():
    representation = HumanML()
    encoded = representation.encode_many(walks(6))
    representation.mean.copy_(encoded[0].mean(0))
    lengths = torch.tensor([len(x) for x in encoded])
    x = torch.nn.utils.rnn.pad_sequence(
        [representation.normalize(x) for x in encoded], batch_first=True
    )
    real = length_mask(lengths)
    copies = noisy_copies(representation, x, lengths, torch.zeros(6))
    assert torch.equal(copies[3:], x[3:])
    assert not copies[~real].any()
    joints = representation.to_joints(x)
    before_last = real & length_mask(lengths - 1, x.shape[1])
    torch.testing.assert_close(
        representation.to_joints(copies)[before_last], joints[before_last], atol=1e-4, rtol=0
    )

    torch.manual_seed(4)
    copies = noisy_copies(representation, x, lengths, torch.full((6,), 0.5))
    height = representation.slices["root_height"]
    moved = (copies - x)[..., height][:3][real[:3]]
    assert moved.std().item() == pytest.approx(0.01, rel=0.15)
    assert abs(moved.mean().item()) < 0.002  # the lowest joint is not put on the floor again
    assert (copies - x)[3:][real[3:]].std().item() == pytest.approx(0.15, rel=0.02)
    torch.manual_seed(4)
    assert torch.equal(noisy_copies(representation, x, lengths, torch.full((6,), 0.5)), copies)


def test_only_representations_of_joints_are_calibrated():
    config = compose("motion_clip/synthetic_calibrated")
    with pytest.raises(
        UserError, match=r"representation=smpl147: CalibratedMotionCLIPTask adds noise to joints"
    ):
        CalibratedMotionCLIPTask.build(config, SMPL())


RUN = [
    "data.source.clips=800",
    "data.batch_size=32",
    "condition=learned",
    "condition.features=32",
    "logger=csv",
]
RUN += [
    "trainer.accelerator=cpu",
    "trainer.enable_progress_bar=false",
    "trainer.log_every_n_steps=5",
]
RUN += [
    f"task.network.{size}"
    for size in ("latent_dim=32", "ff_size=32", "num_layers=1", "embedding_dim=16")
]


@pytest.mark.slow
def test_training_by_recipe_learns_to_retrieve_and_its_checkpoint_is_a_feature_extractor(
    tmp_path, data_root, subtests
):
    options = [f"data_root={data_root}/clip", f"run.dir={tmp_path / 'run'}", "trainer.max_steps=90"]
    options += ["trainer.val_check_interval=30", "optimizer.lr=0.003"]
    assert main(["train", "motion_clip/synthetic", *RUN, *options]) == 0
    trained, curves = tmp_path / "run" / "checkpoints" / "last.ckpt", read_history(tmp_path / "run")
    last = max(curves["val/loss"])
    assert curves["val/loss"][last] < 0.8 * math.log(32)
    for way in ("texts_for_motion", "motions_for_text"):
        with subtests.test(way=way):
            tops = [curves[f"val/{way}_top{k}"][last] for k in (1, 2, 3)]
            assert tops == sorted(tops)
            assert tops[0] > 3 / 32, way  # by chance: 1 / 32
    temperature = curves["train/temperature"]
    assert temperature[min(temperature)] == pytest.approx(0.07, rel=0.1)

    task = load_task(trained, MotionCLIPTask)
    x, mask = torch.randn(2, 30, task.representation.features), length_mask(torch.tensor([30, 24]))
    features = task(task.representation.denormalize(x), mask)
    assert features.shape == (2, task.network.output.out_features)
    torch.testing.assert_close(features, task.network(x, mask), atol=1e-4, rtol=1e-4)
    texts = task.text(
        ["a person walks forward", "a person waves with the left hand", "a person walks forward"]
    )
    assert torch.equal(texts[0], texts[2])
    assert not torch.allclose(texts[0], texts[1], atol=1e-3)
    facts = read_checkpoint(trained)["facts"]
    assert facts["dataset"] == "synthetic"
    assert facts["fingerprint"]
    with pytest.raises(
        UserError, match=r"last\.ckpt: contains a motion-CLIP, not a motion generator"
    ):
        load(trained)

    own, exported = (
        MotionCLIPExtractor(str(trained)),
        MotionCLIPExtractor(str(export(trained, tmp_path))),
    )
    assert exported.sha256 == own.sha256
    halves = MotionCLIPExtractor(str(export(trained, tmp_path / "half.safetensors", half=True)))
    assert halves.sha256 != exported.sha256


@pytest.mark.slow
def test_a_calibrated_run_resumes_exactly(tmp_path, data_root, capsys):
    """Checkpoints after four steps at once, and after two and two, are equal; 32 captions are too few to retrieve."""
    options = [
        f"data_root={data_root}/few",
        "trainer.val_check_interval=2",
        "callbacks.checkpoints.every_n_steps=2",
    ]
    options += ["data.source.clips=60", "data.batch_size=8"]
    weights = []
    for stops in ((4,), (2, 4)):
        folder = tmp_path / str(len(stops))
        for steps in stops:
            # A resumed run would overwrite its file
            logger = ["logger=csv"] if stops == (4,) else []
            words = [word for word in RUN if word != "logger=csv"] + options + logger
            command = ["train", "motion_clip/synthetic_calibrated", *words]
            assert main([*command, f"run.dir={folder}", f"trainer.max_steps={steps}"]) == 0, (
                capsys.readouterr().err
            )
        weights.append(read_checkpoint(folder / "checkpoints" / "last.ckpt")["state_dict"])
    curves = read_history(tmp_path / "1")
    assert "val/loss" in curves
    assert not [name for name in curves if "top1" in name]
    assert weights[0].keys() == weights[1].keys()
    assert all(torch.equal(value, weights[1][name]) for name, value in weights[0].items())
    task = load_task(folder / "checkpoints" / "last.ckpt", MotionCLIPTask)
    assert isinstance(task, CalibratedMotionCLIPTask)
    features = task(torch.randn(2, 9, 263), length_mask(torch.tensor([9, 6])))
    for vectors in (features, task.text(["a person jumps", "someone bows"])):
        torch.testing.assert_close(vectors.norm(dim=1), torch.tensor([10.0, 10.0]))
    assert len(features.unique(dim=0)) == 2


def test_near_misses_change_with_step_and_attribute(subtests):
    task = CalibratedMotionCLIPTask.__new__(CalibratedMotionCLIPTask)
    torch.nn.Module.__init__(task)
    task.seed, task.near_misses = 0, {"a": [["left", "l"], ["twice"]], "b": []}
    for step in range(20):
        with subtests.test(step=step):
            texts = [task.near_miss("a", number, step) for number in range(2)]
            assert texts == [task.near_miss("a", number, step) for number in range(2)]
            assert sorted(text == "twice" for text in texts) == [False, True]
    assert {task.near_miss("a", 0, step) for step in range(20)} == {"left", "l", "twice"}
    assert task.near_miss("b", 0, 0) == ""


def test_half_of_the_motions_have_copies_of_mostly_weak_noise_and_errors_count_fivefold(
    monkeypatch,
):
    """The contrast is 2 and the error is 3; a batch of 5 has 3 copies, and two near misses for each motion."""
    strengths: list[torch.Tensor] = []
    texts: list[list[str]] = []
    meanings: list[torch.Tensor] = []

    def noisy(
        _: Any, x: torch.Tensor, lengths: torch.Tensor, strength: torch.Tensor
    ) -> torch.Tensor:
        strengths.append(strength)
        assert len(x) == len(lengths) == len(strength)
        return x

    def contrast(motion: Any, text: Any, scale: Any, meaning: Any, wrong: Any) -> torch.Tensor:
        meanings.append(meaning)
        assert (len(motion), wrong.shape) == (len(text), (len(text), 2, 4))
        return torch.tensor(2.0)

    def encoded(batch: Any) -> torch.Tensor:
        texts.append(batch.text)
        return torch.zeros(len(batch.text), 4)

    module = "evaluators.extractors.motion_clip_calibrated"
    monkeypatch.setattr(f"{module}.noisy_copies", noisy)
    monkeypatch.setattr(f"{module}.info_nce", contrast)
    monkeypatch.setattr(f"{module}.calibration_error", lambda *_: torch.tensor(3.0))
    names = [f"clip {number}" for number in range(5)]
    net = torch.nn.Bilinear(1, 1, 4)
    net.forward = lambda x, mask: torch.zeros(len(x), 4)  # type: ignore[method-assign]
    net.logit_scale = torch.tensor(0.0)  # type: ignore[assignment]
    task: Any = SimpleNamespace(
        seed_step=torch.manual_seed, near_miss=lambda name, number, step: f"{name} {number} {step}",
        text_features=encoded, meanings={name: [1, 2] for name in names}, representation=None,
        device="cpu", network=net, report=lambda _: None,
    )  # fmt: skip
    mask = torch.ones(5, 6, dtype=torch.bool)
    batch = MotionBatch(torch.randn(5, 6, 7), mask, names, text=[f"says {name}" for name in names])
    for step in range(200):
        assert CalibratedMotionCLIPTask.training_step(task, batch, step) == 2 + 5 * 3
    assert {len(strength) for strength in strengths} == {3}
    drawn = torch.cat(strengths)
    assert drawn.mean().item() == pytest.approx(1 / 3, abs=0.05)  # of a square of a uniform number
    assert drawn.median().item() == pytest.approx(1 / 4, abs=0.06)
    assert texts[7] == [
        *(f"says {name}" for name in names),
        *(f"{name} {number} 7" for name in names for number in range(2)),
    ]
    assert meanings[0][:, :2].tolist() == [[1, 2]] * 5
    assert len(meanings[0][:, 2].unique()) == 5


def test_motions_with_equal_captions_or_attributes_have_equal_meanings(monkeypatch):
    walk, run = {"action": "walk", "side": "left"}, {"action": "run", "side": "left"}
    clips = [
        Entry(f"{number}", 0, 40, "train", "", captions, None, attributes)
        for number, (captions, attributes) in enumerate(
            [
                (["a", "b"], walk), (["b", "a"], run), (["c"], walk),
                (["d"], {"side": "left"}), (["e"], {"side": "left"}),
            ]
        )
    ]  # fmt: skip
    task = CalibratedMotionCLIPTask.__new__(CalibratedMotionCLIPTask)
    torch.nn.Module.__init__(task)
    trainer = SimpleNamespace(datamodule=SimpleNamespace(train=SimpleNamespace(clips=clips)))
    monkeypatch.setattr(CalibratedMotionCLIPTask, "trainer", trainer)
    monkeypatch.setattr(MotionCLIPTask, "on_fit_start", lambda self: None)
    task.on_fit_start()
    captions, attributes = zip(*(task.meanings[clip.id] for clip in clips), strict=True)
    assert [captions.index(meaning) for meaning in captions] == [0, 0, 2, 3, 4]
    assert [attributes.index(meaning) for meaning in attributes] == [0, 1, 0, 3, 4]
    assert not set(captions) & set(attributes)
