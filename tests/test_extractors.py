"""Networks that the papers evaluate with: the authors' outputs, and loading of the authors' files."""

import hashlib
import json
import pickle
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import torch
from support.fixtures import (
    GOLDEN,
    Arrays,
    assert_within,
    golden,
    golden_case,
    groups,
    meta,
    needs_third_party,
    third_party,
    weights,
)
from support.stores import write_words
from torch import Tensor, nn
from torchmetrics import MeanMetric

from evaluators.extractors import (
    CLASSIFIERS,
    ClassifierExtractor,
    MARDMClipExtractor,
    MotionCLIPExtractor,
    OwnExtractor,
    OwnT2MExtractor,
    ReleasedExtractor,
    T2MExtractor,
)
from evaluators.extractors.action_gru import ActionGRU
from evaluators.extractors.classifier import ClassifierTask
from evaluators.extractors.mardm import MARDMClip
from evaluators.extractors.motion_clip import MotionCLIP, MotionCLIPTask
from evaluators.extractors.stgcn import STGCN, UESTC, JointSTGCN, Unconstrained
from evaluators.extractors.t2m import PARTS_OF_SPEECH, T2MEvaluator, Words, WordVectors, load_t2m
from evaluators.extractors.t2m_training import T2MTask
from evaluators.extractors.training import ExtractorTask
from evaluators.metrics.alignment import MotionsForText, MultimodalDistance
from flame_mdm.batch import length_mask
from flame_mdm.checkpoints.released_weights import load_strictly
from flame_mdm.config import compose, instantiate
from flame_mdm.errors import UserError
from flame_mdm.representations.essential import Essential
from flame_mdm.representations.humanml import HumanML
from flame_mdm.representations.rot6d import Rot6D
from flame_mdm.seeds import key

FLIP = torch.tensor([1.0, -1.0, -1.0])


def assert_padding_is_not_seen(
    network: nn.Module, x: Tensor, lengths: list[int], atol: float = 1e-5
) -> None:
    """Outputs of motions (B, F, ...) are the same alone, without what follows their end."""
    with torch.no_grad():
        together = network(x, length_mask(torch.tensor(lengths), x.shape[1]))
        for row, length in enumerate(lengths):
            alone = network(x[row : row + 1, :length], torch.ones(1, length, dtype=torch.bool))
            torch.testing.assert_close(alone[0], together[row], atol=atol, rtol=1e-4)


STATISTICS = (("mean", 0.0), ("std", 1.0))
T2M_PARTS = ("movement_encoder", "text_encoder", "motion_encoder")
TINY = dict.fromkeys(
    ("movement_hidden", "movement_latent", "text_hidden", "motion_hidden", "embedding"), 8
)


def t2m(arrays: Arrays) -> T2MEvaluator:
    state = weights(arrays)
    # MARDM's evaluator sees 67 features and has statistics of its own
    mardm = "in/feats" in arrays
    features = 67 if mardm else arrays["in/motions"].shape[2]
    mean, std = (
        torch.from_numpy(arrays[f"in/{n}"]) if mardm else torch.full((features,), v)
        for n, v in STATISTICS
    )
    network = T2MEvaluator(
        mean,
        std,
        used_features=67 if mardm else None,
        movement_hidden=len(state["movement_encoder/main.0.weight"]),
        movement_latent=len(state["movement_encoder/out_net.weight"]),
        text_hidden=len(state["text_encoder/input_emb.weight"]),
        motion_hidden=len(state["motion_encoder/input_emb.weight"]),
        embedding=len(state["text_encoder/output_net.3.weight"]),
        max_frames=arrays["in/feats" if mardm else "in/motions"].shape[1],
    )
    names = {
        name.replace("/", "."): value for name, value in state.items() if "contrast" not in name
    }
    network.load_state_dict({"mean": network.mean, "std": network.std, **names})
    return network.eval()


@pytest.mark.golden
@pytest.mark.parametrize("stem", ["t2m_evaluator", "essential67"])
def test_t2m_and_mardms_variant_give_the_authors_embeddings(stem):
    arrays = golden(stem)
    network = t2m(arrays)
    captions = (
        torch.from_numpy(arrays[f"in/{name}"]) for name in ("word_embs", "pos_onehot", "cap_lens")
    )
    theirs = torch.from_numpy(arrays["out/align_idx"])  # the authors sort by length
    with torch.no_grad():
        text = network.text(Words(*captions))
        if stem == "essential67":
            prefix, x, lengths = (
                "",
                torch.from_numpy(arrays["in/feats"]),
                torch.from_numpy(arrays["in/lengths"]),
            )
            movements = network.movement_encoder(torch.from_numpy(arrays["out/normed"]))
            motion = network(x, length_mask(lengths, x.shape[1]))
            assert torch.equal(network(x[..., :67], length_mask(lengths, x.shape[1])), motion)
        else:  # frames past the end of these motions are not 0, as in no evaluation
            prefix = "out/"
            movements = network.movement_encoder(torch.from_numpy(arrays["in/motions"])[..., :-4])
            motion = network.motion_encoder(movements, torch.from_numpy(arrays["in/m_lens"]) // 4)
            assert_within(motion[theirs], arrays, "out/motion_embedding_only")
    for name, ours in (
        ("movements_unsorted", movements),
        ("text_embedding_unsorted", text),
        ("text_embedding", text[theirs]),
        ("motion_embedding", motion[theirs]),
    ):
        assert_within(ours, arrays, f"out/{name}", like=f"{prefix}{name}")


@pytest.mark.golden
@pytest.mark.parametrize(
    "features", [pytest.param(f, id=f"state_dict_manifest-t2m_{f}") for f in (263, 251)]
)
def test_recipes_of_t2m_have_the_sizes_of_the_released_networks(features, subtests):
    manifest = json.loads((GOLDEN / "state_dict_manifest.json").read_text())
    config = compose({263: "t2m/humanml3d", 251: "t2m/kit"}[features])
    representation = instantiate(config["representation"])
    with torch.device("meta"):
        network = T2MTask.build(config, representation).network
    keys = (f"t2m_movement_encoder_{features}", "t2m_text_encoder", "t2m_motion_encoder")
    for ours, theirs in zip(T2M_PARTS, keys, strict=True):
        with subtests.test(part=ours):
            shapes = {
                name: list(value.shape)
                for name, value in network.get_submodule(ours).state_dict().items()
            }
            assert shapes == manifest[theirs]["keys"]


def test_t2m_normalizes_with_its_own_statistics_and_sees_nothing_past_the_end(subtests):
    torch.manual_seed(0)
    plain = T2MEvaluator(torch.zeros(20), torch.ones(20), **TINY).eval()
    mean, std = torch.randn(20), torch.rand(20) + 0.5
    scaled = T2MEvaluator(mean, std, **TINY).eval()
    scaled.load_state_dict({**plain.state_dict(), "mean": mean, "std": std})
    x, mask = torch.randn(2, 12, 20), length_mask(torch.tensor([12, 8]))
    torch.testing.assert_close(scaled(x * std + mean, mask), plain(x, mask), atol=1e-5, rtol=1e-4)
    contacts = x + torch.nn.functional.pad(torch.ones(4), (16, 0))
    assert torch.equal(plain(contacts, mask), plain(x, mask))
    assert_padding_is_not_seen(scaled, x, [12, 8])
    for length in (3, 200):
        with (
            subtests.test(length=length),
            pytest.raises(
                UserError, match=f"motions of 4 to 196 frames, but these have {length} to {length}"
            ),
        ):
            plain(torch.zeros(1, length, 20), torch.ones(1, length, dtype=torch.bool))


WORDS = ["unk", "sos", "eos", "a", "person", "walk", "left", "hand", "hop"]
VECTORS = np.arange(len(WORDS) * 300, dtype=np.float64).reshape(len(WORDS), 300)
"""Row times 300 and the 299 numbers after it."""


def slots(words: Words, caption: int) -> list[tuple[int, str]]:
    """Row of the vector and part of speech of each slot of a caption."""
    assert (words.parts.sum(2) == 1).all()
    rows, parts = (
        (words.vectors[caption, :, 0] / 300).int().tolist(),
        words.parts[caption].argmax(1).tolist(),
    )
    return [(row, PARTS_OF_SPEECH[part]) for row, part in zip(rows, parts, strict=True)]


def test_words_have_vectors_and_parts_of_speech(tmp_path, subtests):
    write_words(tmp_path, WORDS, VECTORS)
    vectors = WordVectors.read(tmp_path)
    captions = [
        ["a/DET", "person/NOUN", "walk/VERB", "zigzag/NOUN", "left/ADJ", "hand/NOUN", "hop/X"],
        ["a/DET"] * 25,
    ]
    words = vectors(captions)
    assert (words.vectors.shape, words.parts.shape) == ((2, 22, 300), (2, 22, 15))
    without_vector = (0, "OTHER")
    assert slots(words, 0) == [
        *((1, "OTHER"), (3, "DET"), (4, "NOUN"), (5, "Act_VIP"), without_vector),
        *((6, "Loc_VIP"), (7, "Body_VIP"), (8, "Act_VIP"), (2, "OTHER")),
        *[without_vector] * 13,
    ]
    assert slots(words, 1) == [(1, "OTHER"), *[(3, "DET")] * 20, (2, "OTHER")]
    assert words.lengths.tolist() == [9, 22]
    assert vectors(captions, full_length=True).lengths.tolist() == [22, 22]

    with pytest.raises(FileNotFoundError, match=r"our_vab_idx\.pkl"):
        WordVectors.read(tmp_path / "elsewhere")
    index = tmp_path / "our_vab_idx.pkl"
    for content, message in (
        (index.read_bytes()[:20], r"our_vab_idx\.pkl"),
        (
            pickle.dumps({"a": 0}),
            "not the released GloVe vectors, which have one row each for sos, eos, unk",
        ),
        (pickle.dumps({"unk": 0, "sos": 1, "eos": 99}), "have one row each"),
    ):
        with subtests.test(content=content, message=message):
            index.write_bytes(content)
            with pytest.raises(UserError, match=message):
                WordVectors.read(tmp_path)


@pytest.fixture
def small_networks(monkeypatch):
    """Released files hold networks that are smaller than the published ones."""
    sizes = {"width": 16, "hidden": 16, "layers": 1, "heads": 2}
    monkeypatch.setattr("evaluators.extractors.t2m.T2MEvaluator", partial(T2MEvaluator, **TINY))
    monkeypatch.setattr("evaluators.extractors.MARDMClip", partial(MARDMClip, **sizes))
    return sizes


def released_folder(folder: Path, features: int) -> T2MEvaluator:
    """Writes statistics and random weights of the evaluator, by the authors' names."""
    torch.manual_seed(0)
    mean, std = np.random.default_rng(0).normal(size=features), np.full(features, 2.0)
    np.save(folder / "mean.npy", mean)
    np.save(folder / "std.npy", std)
    used = features if features == 67 else None
    network = T2MEvaluator(
        torch.from_numpy(mean), torch.from_numpy(std), used_features=used, **TINY
    ).eval()
    torch.save(
        {name: network.get_submodule(name).state_dict() for name in T2M_PARTS},
        folder / "finest.tar",
    )
    return network


@pytest.mark.usefixtures("small_networks")
def test_the_released_t2m_is_read_whole_or_not_at_all(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"finest\.tar, .*mean\.npy, .*no such file\. Use"):
        T2MExtractor(str(tmp_path))
    made = released_folder(tmp_path, 251)
    write_words(tmp_path, WORDS, np.random.default_rng(0).normal(size=VECTORS.shape))
    extractor, legacy = T2MExtractor(str(tmp_path)), T2MExtractor(str(tmp_path), full_length=True)
    x, mask = torch.randn(1, 40, 251), torch.ones(1, 40, dtype=torch.bool)
    with torch.no_grad():
        assert torch.equal(extractor.motions(x, torch.zeros(0), mask)["features"], made(x, mask))
        captions = [["walk/VERB"], ["hop/VERB"], ["walk/VERB"] * 20]
        full, short = (extractor.texts(["", "", ""], captions) for extractor in (legacy, extractor))
    assert short.shape == (3, 8)
    assert not torch.allclose(short[0], short[1], atol=1e-6)
    assert not torch.allclose(full[0], short[0], atol=1e-3), (
        "the slots behind the caption are read, too"
    )
    torch.testing.assert_close(full[2], short[2])
    with pytest.raises(UserError, match="tagged words"):
        extractor.texts(["walk"], [None])
    kit = HumanML(skeleton="kit21", fps=12.5, variant="legacy")
    extractor.check(kit, "kit")
    with pytest.raises(UserError, match="bandai"):
        extractor.check(kit, "bandai")

    file = torch.load(tmp_path / "finest.tar")
    file["text_encoder"].pop("hidden")
    torch.save(file, tmp_path / "finest.tar")
    with pytest.raises(
        UserError, match=r"finest\.tar: not the weights of _TextEncoder: Missing key.*hidden"
    ):
        load_t2m(tmp_path)


@golden_case("essential67")
def test_mardms_clip_gives_the_authors_vectors(stem):
    arrays = golden(stem)
    state, config = weights(arrays, "state/contrast_model/"), meta(arrays)["config"]
    network = MARDMClip(
        torch.from_numpy(arrays["in/mean"]),
        torch.from_numpy(arrays["in/std"]),
        width=state["out.weight"].shape[1],
        hidden=len(state["textTransEncoder.layers.0.linear1.weight"]),
        layers=config["clip_layers"],
        heads=config["clip_heads"],
        words=len(state["token_embedding.weight"]),
        slots=len(state["positional_embedding"]),
    )
    load_strictly(network, state, stem)
    features, lengths = torch.from_numpy(arrays["in/feats"]), torch.from_numpy(arrays["in/lengths"])
    with torch.no_grad():
        motion = network(features, length_mask(lengths, features.shape[1]))
        text = network.text(torch.from_numpy(arrays["in/tokens"]))
    assert_within(motion, arrays, "out/clip_motion", like="clip_motion")
    assert_within(text, arrays, "out/clip_text", like="clip_text")
    assert (motion * text).sum(-1).mean().item() == pytest.approx(
        float(arrays["out/clip_score"]), abs=1e-6
    )


def test_released_evaluators_of_mardm_are_read(tmp_path, small_networks):
    made = released_folder(tmp_path, 67)
    x, mask = torch.randn(1, 40, 263), torch.ones(1, 40, dtype=torch.bool)
    assert torch.equal(load_t2m(tmp_path)(x, mask), made(x[..., :67], mask))
    with pytest.raises(UserError, match="contains no weights under 'contrast_model'"):
        MARDMClipExtractor(str(tmp_path))
    statistics = (torch.from_numpy(np.load(tmp_path / f"{name}.npy")) for name, _ in STATISTICS)
    clip = MARDMClip(*statistics, **small_networks).eval()
    torch.save({"contrast_model": clip.state_dict(), "epoch": 1}, tmp_path / "finest.tar")
    extractor = MARDMClipExtractor(str(tmp_path))
    with torch.no_grad():
        vectors = extractor.motions(x, torch.zeros(0), mask)["features"]
        assert torch.equal(vectors, clip(x, mask))
        assert vectors.norm().item() == pytest.approx(1, abs=1e-6)
    for representation in (HumanML(variant="legacy"), Essential(variant="legacy")):
        extractor.check(representation, "humanml3d")
    with pytest.raises(UserError, match="made for humanml-legacy-smpl22 of humanml3d, but"):
        extractor.check(HumanML(), "humanml3d")


@pytest.mark.golden
@needs_third_party
@pytest.mark.parametrize(
    "start", [pytest.param(s, id=f"humanact12_gru-{s or 'given'}") for s in ("", "_h0_zero")]
)
def test_the_gru_gives_the_authors_features_and_logits(start):
    arrays = third_party("humanact12_gru")
    network = ActionGRU().eval()
    network.load_state_dict(weights(arrays))
    joints = torch.from_numpy(arrays["in/xyz"]).permute(0, 3, 1, 2)
    mask = length_mask(torch.from_numpy(arrays["in/lengths"]), joints.shape[1])
    state = None if start else torch.from_numpy(arrays["in/hidden_unit"])
    with torch.no_grad():
        features = network.published(joints, mask, state)
        assert_within(features, arrays, f"out/features{start}", like="out/features")
        assert_within(network.linear2(features), arrays, f"out/logits{start}", like="out/logits")


def test_classifiers_of_joints_stop_at_the_end_and_do_not_see_where_the_motion_stands(subtests):
    torch.manual_seed(0)
    for network, joints in ((ActionGRU().eval(), 24), (small().eval(), 4)):
        with subtests.test(joints=joints):
            x, mask = torch.randn(3, 60, joints, 3), length_mask(torch.tensor([60, 31, 1]))
            assert_padding_is_not_seen(network, x, [60, 31, 1])
            features = network(x, mask)
            torch.testing.assert_close(
                network(x + torch.tensor([3.0, -1, 2]), mask), features, atol=1e-4, rtol=0
            )
            path = torch.linspace(0, 1, 60)[:, None, None]
            assert not torch.allclose(network(x + path, mask), features, atol=1e-3), (
                "but which way it goes"
            )


NETWORKS = {"uestc": UESTC, "unconstrained": Unconstrained}


def formula_weights(network: nn.Module) -> None:
    """The fixture's weights, which a formula gives (its `meta.weights`)."""
    state = network.state_dict()
    for number, name in enumerate(sorted(state)):
        value = state[name]
        if name == "A" or name.endswith("num_batches_tracked"):
            continue
        wave = torch.cos(
            1.3 * number + 0.61803398875 * torch.arange(value.numel(), dtype=torch.float64)
        )
        wave = wave.reshape(value.shape)
        one_sided = name.startswith("edge_importance") or name.endswith("running_var")
        if one_sided or (value.ndim == 1 and name.endswith("weight")):
            state[name] = 1 + 0.1 * wave
        elif value.ndim >= 2:
            state[name] = 1.5 * wave / np.sqrt(np.prod(value.shape[1:]))
        else:
            state[name] = 0.1 * wave
    network.load_state_dict(state)


@pytest.mark.golden
@pytest.mark.parametrize(
    "name", [pytest.param(n, id=f"stgcn-{n}") for n in groups(golden("stgcn"), "adjacency_A")]
)
def test_stgcn_gives_the_authors_features_and_logits(name):
    """Also for motions as this project gives them: 25 x 6 features, or 24 joints with y up."""
    arrays = golden("stgcn")
    network = NETWORKS[name]().eval()
    shapes = {key: list(value.shape) for key, value in network.state_dict().items()}
    assert shapes == meta(arrays)["state_dict_shapes"][name]
    np.testing.assert_allclose(network.A.numpy(), arrays[f"{name}/adjacency_A"], atol=1e-7)
    formula_weights(network)
    x = torch.from_numpy(arrays[f"{name}/x"]).permute(0, 3, 1, 2)
    mask = torch.ones(x.shape[:2], dtype=torch.bool)
    with torch.no_grad():
        features = STGCN.forward(network, x, mask)
        assert_within(features, arrays, f"{name}/features")
        assert_within(network.fcn(features[..., None, None])[..., 0, 0], arrays, f"{name}/yhat")
        if name == "uestc":
            way = torch.randn(*x.shape[:2], 1, 6)
            assert_within(
                network(torch.cat([x, way], 2).flatten(2), mask), arrays, f"{name}/features"
            )
        else:
            joints = torch.randn(*x.shape[:2], 24, 3)
            joints[:, :, [15, 12, 16, 18, 20, 17, 19, 21, 0, 1, 4, 7, 2, 5, 8]] = x * FLIP
            seen = x - x[:, :, 8:9]  # from the pelvis
            torch.testing.assert_close(
                network(joints, mask), STGCN.forward(network, seen, mask), atol=1e-5, rtol=0
            )
            torch.testing.assert_close(
                network(joints + 7, mask), network(joints, mask), atol=1e-4, rtol=0
            )


def small() -> JointSTGCN:
    return JointSTGCN((-1, 0, 1, 0), 5, widths=(4, 6), strides=(1, 2))


def test_stgcn_classifies_and_sees_nothing_past_the_end(subtests):
    for make, shape, actions in ((UESTC, (150,), 40), (Unconstrained, (24, 3), 12)):
        with subtests.test(make=make, shape=shape, actions=actions):
            torch.manual_seed(0)
            network = make().eval()
            x, mask = torch.randn(3, 20, *shape), torch.ones(3, 20, dtype=torch.bool)
            with torch.no_grad():
                features, logits = network(x, mask), network.logits(x, mask)
            assert (features.shape, logits.shape) == ((3, network.fcn.in_channels), (3, actions))
            torch.testing.assert_close(
                logits, features @ network.fcn.weight.flatten(1).T + network.fcn.bias
            )
            assert_padding_is_not_seen(network, x, [20, 13, 1])


class _Runs:
    def __reduce__(self):
        return (pytest.fail, ("code of the file was run",))


@pytest.mark.parametrize("kind", CLASSIFIERS)
def test_released_weights_are_loaded_whole_or_not_at_all(tmp_path, kind, subtests):
    make, key, _ = CLASSIFIERS[kind]
    path, state = tmp_path / "weights.tar", make().state_dict()
    name = next(iter(state))

    def write(content: Any) -> None:
        torch.save({key: content, "iteration": 3} if key else content, path)

    write(state)
    extractor = ClassifierExtractor(kind, str(path))
    assert not extractor.network.training
    assert all(
        torch.equal(value, state[name]) for name, value in extractor.network.state_dict().items()
    )
    x, mask = torch.randn(3, 20, 150), length_mask(torch.tensor([20, 9, 20]))
    with torch.no_grad():
        outputs = extractor.motions(x, Rot6D().decode(x), mask)
    assert (outputs["logits"].shape, len(outputs["features"])) == (
        (3, 40 if kind == "uestc" else 12),
        3,
    )
    assert extractor.texts(["walk"], [None]) is None
    extractor.check(Rot6D(), extractor.made_for[1])
    with pytest.raises(UserError, match="bandai"):
        extractor.check(Rot6D(), "bandai")
    if make is not ActionGRU:
        with pytest.raises(UserError, match="not recurrent"):
            ClassifierExtractor(kind, str(path), random_start=True)
    for content, message in (
        (
            {k: v for k, v in state.items() if k != name},
            rf"not the weights of {make.__name__}: Missing key.*{name}",
        ),
        ({**state, "extra": torch.zeros(1)}, "Unexpected key.*extra"),
        ({**state, "extra": _Runs()}, r"contains Python objects \(_pytest"),
    ):
        with subtests.test(content=content, message=message):
            write(content)
            with pytest.raises(UserError, match=rf"weights\.tar: .*{message}"):
                ClassifierExtractor(kind, str(path))
    path.write_bytes(path.read_bytes()[:500])
    with pytest.raises(UserError, match=r"weights\.tar: damaged"):
        ClassifierExtractor(kind, str(path))
    with pytest.raises(FileNotFoundError, match=r"absent\.tar: no such file\. Use the path"):
        ClassifierExtractor(kind, str(tmp_path / "absent.tar"))


def test_a_random_start_is_a_function_of_the_motion(tmp_path, subtests):
    torch.save({"model": ActionGRU().state_dict()}, tmp_path / "gru")
    path = str(tmp_path / "gru")
    plain, legacy = (
        ClassifierExtractor("humanact12", path, random_start=start) for start in (False, True)
    )
    x, mask = torch.randn(3, 20, 150), length_mask(torch.tensor([20, 9, 20]))
    joints = Rot6D().decode(x)
    with torch.no_grad():
        drawn, again = (
            legacy.motions(x, joints, mask),
            legacy.motions(x.flip(0), joints.flip(0), mask.flip(0)),
        )
        alone = legacy.motions(x[1:2, :9], joints[1:2, :9], mask[1:2, :9])
        zero = plain.motions(x, joints, mask)
    for name in ("features", "logits"):
        with subtests.test(name=name):
            torch.testing.assert_close(drawn[name], again[name].flip(0))
            torch.testing.assert_close(drawn[name][1:2], alone[name])
            assert not torch.allclose(drawn[name], zero[name], atol=1e-3)
    network: Any = legacy.network
    assert not torch.allclose(network.linear2(drawn["features"]), drawn["logits"], atol=1e-3), (
        "two draws"
    )


def test_the_gru_sees_joints_with_y_down_relative_to_the_first_pelvis():
    torch.manual_seed(0)
    network, joints = ActionGRU().eval(), torch.randn(2, 9, 24, 3)
    mask = length_mask(torch.tensor([9, 6]))
    down = joints * FLIP
    relative = down - down[:, 0, 0][:, None, None]
    with torch.no_grad():
        expected = network.published(relative, mask)
        torch.testing.assert_close(network(joints, mask), expected)
        assert not torch.allclose(network.published(joints, mask), expected, atol=1e-3)
        torch.testing.assert_close(network.logits(joints, mask), network.linear2(expected))


def test_a_classifier_learns_from_joints_that_are_zero_past_the_end():
    seen: list[Tensor] = []

    def logits(joints: Tensor, mask: Tensor) -> Tensor:
        seen.append(joints)
        return torch.zeros(len(joints), 2)

    task: Any = SimpleNamespace(
        representation=SimpleNamespace(
            to_joints=lambda x: x[..., None, None].expand(-1, -1, 4, 3) + 1
        ),
        network=SimpleNamespace(logits=logits),
    )
    mask, labels = length_mask(torch.tensor([3, 1])), torch.tensor([1, 0])
    batch: Any = SimpleNamespace(x=torch.zeros(2, 3), mask=mask, action=labels)
    _, action = ClassifierTask._classified(task, batch)
    assert torch.equal(action, labels)
    assert torch.equal(seen[0], mask[..., None, None].float().expand(2, 3, 4, 3))


def represented(name: str, fps: float = 20.0, features: int = 263, part_of: str = "") -> Any:
    return SimpleNamespace(name=name, fps=fps, features=features, part_of=part_of)


@pytest.mark.parametrize(
    ("kind", "other", "reads"),
    [
        (OwnExtractor, represented("a"), True),
        (OwnExtractor, represented("b"), False),
        (OwnExtractor, represented("a", fps=30.0), False),
        (OwnExtractor, represented("a", features=251), False),
        (OwnExtractor, represented("b", features=67, part_of="a"), False),
        (OwnT2MExtractor, represented("a"), True),
        (OwnT2MExtractor, represented("a", fps=30.0), False),
        (OwnT2MExtractor, represented("b", features=67, part_of="a"), True),
        (OwnT2MExtractor, represented("b", features=66, part_of="a"), False),
        (OwnT2MExtractor, represented("b", features=67, part_of="c"), False),
        (OwnT2MExtractor, represented("b", fps=30.0, features=67, part_of="a"), False),
    ],
)
def test_an_extractor_reads_its_own_representation_or_its_part(kind, other, reads):
    extractor = kind.__new__(kind)
    network = SimpleNamespace(used=67)
    extractor.task = SimpleNamespace(representation=represented("a"), network=network)
    assert extractor.reads(other) == reads


def test_a_motion_fits_its_texts_by_the_mean_cosine_of_its_parts():
    """The features of a part are its sums; texts are vectors at angles that they state."""
    extractor = MotionCLIPExtractor.__new__(MotionCLIPExtractor)
    extractor.encoded = {}
    calls: list[list[str]] = []

    class Task:
        def __call__(self, x: Tensor, mask: Tensor) -> Tensor:
            assert mask.shape == x.shape[:2]
            assert mask.all()
            return x.sum(1)

        def text(self, captions: list[str]) -> Tensor:
            calls.append(captions)
            angles = torch.deg2rad(torch.tensor([float(text) for text in captions]))
            return torch.stack([angles.cos(), angles.sin()], 1)

    extractor.task = Task()  # type: ignore[assignment]
    along = np.repeat(np.array([[1.0, 0.0], [0.0, 1.0]], np.float32), [2, 3], 0)
    whole: Any = SimpleNamespace(parts=(), text="90", features=along)
    parts: Any = SimpleNamespace(parts=(("60", 0, 2), ("90", 2, 5)), text="x", features=along)
    assert extractor.fit([whole, parts]) == pytest.approx([3 / 13**0.5, (0.5 + 1) / 2])
    assert calls == [["90"], ["60"]], "no caption is encoded twice"


def test_a_random_start_is_drawn_from_a_normal_distribution_for_each_seed():
    network = ActionGRU(num_joints=2, hidden=300)
    states = network.random_state([3, 4, 3])
    assert states.shape == (2, 3, 300)
    assert torch.equal(states[:, 0], states[:, 2])
    assert torch.equal(network.random_state([4])[:, 0], states[:, 1])
    rows = states[:, :2].flatten(0, 1)
    assert rows.mean().item() == pytest.approx(0, abs=0.1)
    assert rows.std().item() == pytest.approx(1, abs=0.1)
    assert (torch.corrcoef(rows) - torch.eye(4)).abs().max() < 0.2, "layers have their own draws"


def test_draws_of_a_training_step_depend_on_seed_step_and_rank():
    def drawn(seed: int, step: int, rank: int) -> float:
        task: Any = SimpleNamespace(seed=seed, global_rank=rank)
        ExtractorTask.seed_step(task, step)
        return torch.rand(1).item()

    settings = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)]
    assert len({drawn(*setting) for setting in settings}) == 4
    assert [drawn(*setting) for setting in settings] == [drawn(*setting) for setting in settings]


@pytest.mark.parametrize(
    ("rank", "clips", "counts"), [(0, 1, True), (1, 1, False), (1, 2, True), (1, 3, True)]
)
def test_validation_clips_that_every_rank_has_count_once(rank: int, clips: int, counts: bool):
    datamodule = SimpleNamespace(val=range(clips))
    distance = MultimodalDistance()
    task: Any = SimpleNamespace(
        global_rank=rank,
        trainer=SimpleNamespace(datamodule=datamodule, world_size=2),
        val_metrics={"loss": MeanMetric(), "mm_dist": distance, "top": MotionsForText(pool=2)},
        device="cpu",
    )
    batch: Any = SimpleNamespace(ids=["a", "b"], text=["x", "x"])
    motion, text = torch.zeros(2, 3), torch.tensor([[0.0, 3.0, 4.0], [0.0, 0.0, 1.0]])
    ExtractorTask.update_samples(task, batch, generated=motion, text=text)
    assert distance.compute() == (3.0 if counts else None)
    if counts:
        (keys,) = cast(Any, distance.keys)
        assert keys.tolist() == [key("motion", "a"), key("motion", "b")]
        (captions,) = task.val_metrics["top"].text_keys
        assert captions.tolist() == [key("caption", "x")] * 2


def test_a_validation_logs_every_value_that_can_be_computed_and_begins_anew():
    loss, distance, few = MeanMetric(), MultimodalDistance(), MotionsForText(pool=32)
    enough, empty = MotionsForText(pool=2), MultimodalDistance()
    pairs = {"generated": torch.eye(3), "text": torch.eye(3), "text_keys": torch.arange(3)}
    for metric in (few, enough):
        metric.update(**pairs, keys=torch.arange(3))
    distance.update(generated=torch.eye(3), text=torch.zeros(3, 3), keys=torch.arange(3))
    loss.update(torch.tensor([0.0, 0.5]))
    logged: dict[str, tuple[float, bool]] = {}

    def log(name: str, value: Any, *, prog_bar: bool) -> None:
        logged[name] = (float(value), prog_bar)

    metrics = {"loss": loss, "mm_dist": distance, "few": few, "top": enough, "empty": empty}
    task: Any = SimpleNamespace(val_metrics=metrics, log=log)
    ExtractorTask.on_validation_epoch_end(task)
    tops = {f"val/top_top{k}": (1.0, False) for k in (1, 2, 3)}
    assert logged == {"val/loss": (0.25, True), "val/mm_dist": (1.0, False)} | tops
    assert (distance.compute(), few.compute()["top1"], loss.weight.item()) == (None, None, 0)
    few.update(**pairs, keys=torch.arange(3))
    failing: Any = SimpleNamespace(val_metrics={"loss": few}, log=log)
    with pytest.raises(UserError, match="got 3 motions, but needs at least 32"):
        ExtractorTask.on_validation_epoch_end(failing)


def test_the_validation_loss_of_a_classifier_is_the_mean_over_motions_of_unequal_batches():
    batches = [torch.tensor([[2.0, 0.0], [0.0, 1.0], [3.0, 0.0]]), torch.tensor([[0.0, 4.0]])]
    labels = [torch.tensor([0, 1, 1]), torch.tensor([0])]
    updated: list[dict[str, Tensor]] = []
    reported: dict[str, Tensor] = {}
    task: Any = SimpleNamespace(
        val_metrics={"loss": MeanMetric()},
        update_samples=lambda batch, **inputs: updated.append(inputs),
        _classified=lambda number: (batches[number], labels[number]),
        seed_step=lambda step: None,
        report=reported.update,
    )
    losses = [
        -row.log_softmax(0)[label].item()
        for logits, right in zip(batches, labels, strict=True)
        for row, label in zip(logits, right.tolist(), strict=True)
    ]
    for number in range(2):
        step: Any = number
        ClassifierTask.validation_step(task, step, number)
        assert torch.equal(updated[number]["logits"], batches[number])
        assert torch.equal(updated[number]["labels"], labels[number])
    assert task.val_metrics["loss"].compute().item() == pytest.approx(np.mean(losses))
    loss = ClassifierTask.training_step(task, cast(Any, 0), 0)
    assert loss.item() == pytest.approx(np.mean(losses[:3]))
    assert reported["train/loss"] is loss
    assert reported["train/accuracy"].item() == pytest.approx(2 / 3)


def test_the_temperature_of_a_motion_clip_begins_at_seven_hundredths():
    network = MotionCLIP(
        5, 4, latent_dim=8, ff_size=8, num_layers=1, num_heads=2, dropout=0.0, max_frames=9,
        embedding_dim=3,
    )  # fmt: skip
    reported: dict[str, Tensor] = {}
    features = torch.randn(4, 4, generator=torch.Generator().manual_seed(0))
    task: Any = SimpleNamespace(
        network=network.eval(),
        seed_step=lambda step: None,
        text_features=lambda batch: network.text(features),
        report=reported.update,
    )
    batch: Any = SimpleNamespace(
        x=torch.randn(4, 6, 5), mask=length_mask(torch.tensor([6, 5, 4, 3]))
    )
    loss = MotionCLIPTask.training_step(task, batch, 0)
    assert reported["train/temperature"].item() == pytest.approx(0.07)
    cosines = nn.functional.cosine_similarity(
        network(batch.x, batch.mask)[:, None], network.text(features)[None], dim=-1
    )
    both = [nn.functional.cross_entropy(x / 0.07, torch.arange(4)) for x in (cosines, cosines.T)]
    torch.testing.assert_close(loss, (both[0] + both[1]) / 2)


def test_released_networks_are_made_for_the_data_of_their_authors(tmp_path, monkeypatch):
    kinds = {
        "humanact12": (ActionGRU, "model", "humanact12"),
        "humanact12_unconstrained": (Unconstrained, None, "humanact12"),
        "uestc": (UESTC, None, "uestc"),
    }
    assert kinds == CLASSIFIERS
    for name in T2MExtractor.FILES:
        (tmp_path / name).write_bytes(name.encode())
    human, kit = ("humanml-legacy-smpl22", "humanml3d"), ("humanml-legacy-kit21", "kit")
    monkeypatch.setattr(WordVectors, "read", lambda folder: None)
    for features, data in ((263, human), (67, human), (251, kit), (64, kit)):
        network = SimpleNamespace(mean=torch.zeros(features), used=60)
        network.to = lambda device, network=network: network
        monkeypatch.setattr("evaluators.extractors.load_t2m", lambda _, network=network: network)
        extractor = T2MExtractor(str(tmp_path))
        assert (extractor.made_for, extractor.used, extractor.full_length) == (data, 60, False)


def test_the_hash_of_released_files_is_that_of_their_contents(tmp_path):
    class OfTwo(MARDMClipExtractor):
        FILES = ("a", "b")

    class OfOne(MARDMClipExtractor):
        FILES = ()

    def hash_of(kind: type[MARDMClipExtractor], path: Path) -> str:
        extractor = kind.__new__(kind)
        ReleasedExtractor.__init__(extractor, str(path))
        return extractor.sha256

    (tmp_path / "a").write_bytes(b"1")
    (tmp_path / "b").write_bytes(b"2")
    hashes = [hashlib.sha256(content).hexdigest() for content in (b"1", b"2")]
    assert hash_of(OfOne, tmp_path / "a") == hashes[0]
    assert hash_of(OfTwo, tmp_path) == hashlib.sha256("".join(hashes).encode()).hexdigest()
    for name in ("a", "b"):
        before = hash_of(OfTwo, tmp_path)
        (tmp_path / name).write_bytes(b"3")
        assert hash_of(OfTwo, tmp_path) != before
    (tmp_path / "b").unlink()
    with pytest.raises(FileNotFoundError, match=r"b: no such file\. Use the path"):
        hash_of(OfTwo, tmp_path)
