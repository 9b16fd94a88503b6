"""Networks that the papers evaluate with: the authors' outputs, and loading of the authors' files."""

import json
import pickle
from typing import Any

import numpy as np
import pytest
import torch
from support.fixtures import GOLDEN, Arrays, golden, groups, meta, needs_third_party, third_party
from torch import Tensor, nn

from evaluators.extractors import MARDMClipExtractor
from evaluators.extractors.action_gru import NUM_ACTIONS, ActionGRU, load_action_gru
from evaluators.extractors.mardm import MARDMClip
from evaluators.extractors.released import load_strictly
from evaluators.extractors.stgcn import STGCN, UESTC, JointSTGCN, Unconstrained, load_uestc, load_unconstrained
from evaluators.extractors.t2m import PARTS_OF_SPEECH, T2MEvaluator, Words, WordVectors, load_t2m
from flame_mdm.batch import length_mask
from flame_mdm.errors import UserError
from flame_mdm.representations.essential import Essential
from flame_mdm.representations.humanml import HumanML

FLIP = torch.tensor([1.0, -1.0, -1.0])


def weights(arrays: Arrays, prefix: str = "state/") -> dict[str, Tensor]:
    return {name.removeprefix(prefix): torch.from_numpy(v) for name, v in arrays.items() if name.startswith(prefix)}


def assert_within(ours: Tensor, arrays: Arrays, name: str, like: str | None = None) -> None:
    """Ten times what the authors' float32 differs from their float64."""
    tolerance = 10 * meta(arrays)["max_abs_diff_f32_vs_f64"][like or name][0]
    torch.testing.assert_close(ours, torch.from_numpy(arrays[name]), atol=tolerance, rtol=0)


# T2M ------------------------------------------------------------------------------------------------------------------

STATISTICS = (("mean", 0.0), ("std", 1.0))


def t2m(arrays: Arrays, *, keep_padding: bool = False) -> T2MEvaluator:
    state = weights(arrays)
    mardm = "in/feats" in arrays  # MARDM's evaluator sees 67 features and has statistics of its own
    features = 67 if mardm else arrays["in/motions"].shape[2]
    mean, std = (torch.from_numpy(arrays[f"in/{n}"]) if mardm else torch.full((features,), v) for n, v in STATISTICS)
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
        keep_padding=keep_padding,
    )
    names = {name.replace("/", "."): value for name, value in state.items() if "contrast" not in name}
    network.load_state_dict({"mean": network.mean, "std": network.std, **names})
    return network.eval()


def embedded(arrays: Arrays) -> tuple[Tensor, Tensor, Tensor]:
    """Movements, motion and text embeddings, in the order of the input."""
    network = t2m(arrays, keep_padding=True)
    x, lengths = torch.from_numpy(arrays["in/motions"]), torch.from_numpy(arrays["in/m_lens"])
    captions = (torch.from_numpy(arrays[f"in/{name}"]) for name in ("word_embs", "pos_onehot", "cap_lens"))
    with torch.no_grad():
        movements = network.movement_encoder(x[..., :-4])
        return movements, network(x, length_mask(lengths, x.shape[1])), network.text(Words(*captions))


@pytest.mark.golden
@pytest.mark.parametrize("stem", ["t2m_evaluator"])
def test_t2m_gives_the_authors_embeddings(stem):
    arrays = golden(stem)
    movements, motion, text = embedded(arrays)
    assert_within(movements, arrays, "out/movements_unsorted")
    assert_within(text, arrays, "out/text_embedding_unsorted")
    theirs = torch.from_numpy(arrays["out/align_idx"])  # the authors sort by length
    assert_within(text[theirs], arrays, "out/text_embedding")
    assert_within(motion[theirs], arrays, "out/motion_embedding")
    assert_within(motion[theirs], arrays, "out/motion_embedding_only")


@pytest.mark.golden
@pytest.mark.parametrize("features", [pytest.param(f, id=f"state_dict_manifest-t2m_{f}") for f in (263, 251)])
def test_t2m_has_the_sizes_of_the_released_networks(features):
    manifest = json.loads((GOLDEN / "state_dict_manifest.json").read_text())
    with torch.device("meta"):
        network = T2MEvaluator(torch.zeros(features), torch.ones(features))
    for ours, theirs in (
        ("movement_encoder", f"t2m_movement_encoder_{features}"),
        ("text_encoder", "t2m_text_encoder"),
        ("motion_encoder", "t2m_motion_encoder"),
    ):
        shapes = {name: list(value.shape) for name, value in network.get_submodule(ours).state_dict().items()}
        assert shapes == manifest[theirs]["keys"]


@pytest.mark.golden
@pytest.mark.parametrize("stem", ["t2m_evaluator"])
def test_t2m_sees_nothing_past_the_end_unless_asked_to(stem):
    arrays = golden(stem)
    x, lengths = torch.from_numpy(arrays["in/motions"]), torch.from_numpy(arrays["in/m_lens"])
    short = int(lengths.argmin())
    mask = length_mask(lengths, x.shape[1])
    network, legacy = t2m(arrays), t2m(arrays, keep_padding=True)
    noisy = torch.where(mask[..., None], x, torch.randn_like(x))
    together = network(noisy, mask)
    alone = network(x[short : short + 1, : lengths[short]], torch.ones(1, int(lengths[short]), dtype=torch.bool))
    torch.testing.assert_close(together[short], alone[0], atol=1e-5, rtol=0)
    assert not torch.allclose(legacy(noisy, mask)[short], together[short], atol=1e-4)


def test_t2m_normalizes_with_its_own_statistics():
    torch.manual_seed(0)
    sizes: dict[str, Any] = {
        "movement_hidden": 8,
        "movement_latent": 8,
        "text_hidden": 8,
        "motion_hidden": 8,
        "embedding": 8,
    }
    plain = T2MEvaluator(torch.zeros(20), torch.ones(20), **sizes).eval()
    mean, std = torch.randn(20), torch.rand(20) + 0.5
    scaled = T2MEvaluator(mean, std, **sizes).eval()
    scaled.load_state_dict({**plain.state_dict(), "mean": mean, "std": std})
    x, mask = torch.randn(2, 12, 20), length_mask(torch.tensor([12, 8]))
    torch.testing.assert_close(scaled(x * std + mean, mask), plain(x, mask), atol=1e-5, rtol=1e-4)
    contacts = x + torch.nn.functional.pad(torch.ones(4), (16, 0))
    assert torch.equal(plain(contacts, mask), plain(x, mask))
    for length in (3, 200):
        with pytest.raises(ValueError, match=f"motions of 4 to 196 frames, but these have {length} to {length}"):
            plain(torch.zeros(1, length, 20), torch.ones(1, length, dtype=torch.bool))


@pytest.fixture
def word_folder(tmp_path):
    words = ["unk", "sos", "eos", "a", "person", "walk", "left", "hand", "hop"]
    vectors = np.arange(len(words) * 300, dtype=np.float64).reshape(len(words), 300)
    np.save(tmp_path / "our_vab_data.npy", vectors)
    (tmp_path / "our_vab_idx.pkl").write_bytes(pickle.dumps({word: row for row, word in enumerate(words)}))
    return tmp_path


def read(words: Words, caption: int) -> list[tuple[int, str]]:
    """Row of the vector and part of speech of each slot of a caption."""
    assert (words.parts.sum(2) == 1).all()
    rows = (words.vectors[caption, :, 0] / 300).int().tolist()
    return [
        (row, PARTS_OF_SPEECH[part]) for row, part in zip(rows, words.parts[caption].argmax(1).tolist(), strict=True)
    ]


def test_words_have_vectors_and_parts_of_speech(word_folder):
    vectors = WordVectors(word_folder)
    captions = [["a/DET", "person/NOUN", "walk/VERB", "zigzag/NOUN", "left/ADJ", "hand/NOUN", "hop/X"], ["a/DET"] * 25]
    words = vectors(captions)
    assert words.vectors.shape == (2, 22, 300)
    assert words.parts.shape == (2, 22, 15)
    slots = read(words, 0)
    assert slots[:4] == [(1, "OTHER"), (3, "DET"), (4, "NOUN"), (5, "Act_VIP")]
    assert slots[4] == (0, "OTHER")  # a word without a vector
    assert slots[5:9] == [(6, "Loc_VIP"), (7, "Body_VIP"), (8, "Act_VIP"), (2, "OTHER")]
    assert slots[9:] == [(0, "OTHER")] * 13
    assert read(words, 1) == [(1, "OTHER"), *[(3, "DET")] * 20, (2, "OTHER")]
    assert words.lengths.tolist() == [9, 22]
    assert vectors(captions, full_length=True).lengths.tolist() == [22, 22]


def test_word_vectors_that_are_not_the_released_ones_are_refused(word_folder):
    with pytest.raises(FileNotFoundError, match=r"our_vab_data\.npy: no such file\. Give the folder of the GloVe"):
        WordVectors(word_folder / "elsewhere")
    index = word_folder / "our_vab_idx.pkl"
    whole = index.read_bytes()
    index.write_bytes(whole[:20])
    with pytest.raises(ValueError, match=r"our_vab_idx\.pkl"):
        WordVectors(word_folder)
    index.write_bytes(pickle.dumps({"a": 0}))
    with pytest.raises(ValueError, match="have sos, eos, unk"):
        WordVectors(word_folder)
    index.write_bytes(pickle.dumps({"unk": 0, "sos": 1, "eos": 99}))
    with pytest.raises(ValueError, match="9 rows, but the index refers to more"):
        WordVectors(word_folder)


def test_a_released_t2m_file_is_loaded_whole_or_not_at_all(tmp_path):
    torch.manual_seed(0)
    features, parts = 251, ("movement_encoder", "text_encoder", "motion_encoder")
    mean, std = np.random.default_rng(0).normal(size=features), np.full(features, 2.0)
    np.save(tmp_path / "mean.npy", mean)
    np.save(tmp_path / "std.npy", std)
    made = T2MEvaluator(torch.from_numpy(mean), torch.from_numpy(std)).eval()
    file = {name: made.get_submodule(name).state_dict() for name in parts}
    path = tmp_path / "finest.tar"
    torch.save({**file, "epoch": 1, "opt_text_encoder": {"state": {}}}, path)
    loaded = load_t2m(path, tmp_path / "mean.npy", tmp_path / "std.npy")
    x, mask = torch.randn(1, 40, features), torch.ones(1, 40, dtype=torch.bool)
    assert torch.equal(loaded(x, mask), made(x, mask))

    with pytest.raises(FileNotFoundError, match=r"absent\.npy: no such file\. The evaluator needs the statistics"):
        load_t2m(path, tmp_path / "absent.npy", tmp_path / "std.npy")
    torch.save({name: file[name] for name in parts[1:]}, path)
    with pytest.raises(
        ValueError, match=r"finest\.tar: contains no weights under 'movement_encoder', but motion_encoder"
    ):
        load_t2m(path, tmp_path / "mean.npy", tmp_path / "std.npy")
    file["text_encoder"].pop("hidden")
    torch.save(file, path)
    with pytest.raises(ValueError, match=r"finest\.tar: not the weights of _TextEncoder: Missing key.*hidden"):
        load_t2m(path, tmp_path / "mean.npy", tmp_path / "std.npy")


# MARDM ----------------------------------------------------------------------------------------------------------------


@pytest.mark.golden
@pytest.mark.parametrize("stem", ["essential67"])
def test_mardms_evaluator_gives_the_authors_embeddings(stem):
    arrays = golden(stem)
    network, lengths = t2m(arrays), torch.from_numpy(arrays["in/lengths"])
    features = torch.from_numpy(arrays["in/feats"])
    with torch.no_grad():
        motion = network(features, length_mask(lengths, features.shape[1]))
        text = network.text(
            Words(*(torch.from_numpy(arrays[f"in/{n}"]) for n in ("word_embs", "pos_onehot", "cap_lens")))
        )
        movements = network.movement_encoder(torch.from_numpy(arrays["out/normed"]))
    assert_within(movements, arrays, "out/movements_unsorted", like="movements_unsorted")
    assert_within(text, arrays, "out/text_embedding_unsorted", like="text_embedding_unsorted")
    theirs = torch.from_numpy(arrays["out/align_idx"])
    assert_within(motion[theirs], arrays, "out/motion_embedding", like="motion_embedding")
    assert_within(text[theirs], arrays, "out/text_embedding", like="text_embedding")
    cut = network(features[..., :67], length_mask(lengths, features.shape[1]))
    assert torch.equal(cut, network(features, length_mask(lengths, features.shape[1])))


@pytest.mark.golden
@pytest.mark.parametrize("stem", ["essential67"])
def test_mardms_clip_gives_the_authors_vectors(stem):
    arrays = golden(stem)
    state = weights(arrays, "state/contrast_model/")
    config = meta(arrays)["config"]
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
    assert (motion * text).sum(-1).mean().item() == pytest.approx(float(arrays["out/clip_score"]), abs=1e-6)


def test_released_evaluators_of_mardm_are_read(tmp_path):
    """The files have the names and keys of the authors', and random weights."""
    for name, value in STATISTICS:
        np.save(tmp_path / f"{name}.npy", np.full(67, value))
    made = T2MEvaluator(torch.zeros(67), torch.ones(67), used_features=67).eval()
    assert list(made.state_dict()["movement_encoder.main.0.weight"].shape) == [512, 67, 4]
    parts = ("movement_encoder", "text_encoder", "motion_encoder")
    torch.save({name: made.get_submodule(name).state_dict() for name in parts}, tmp_path / "finest.tar")
    x, mask = torch.randn(1, 40, 263), torch.ones(1, 40, dtype=torch.bool)
    files = tmp_path / "finest.tar", tmp_path / "mean.npy", tmp_path / "std.npy"
    assert torch.equal(load_t2m(*files)(x, mask), made(x[..., :67], mask))
    with pytest.raises(ValueError, match="contains no weights under 'contrast_model'"):
        MARDMClipExtractor(str(tmp_path))
    clip = MARDMClip(torch.zeros(67), torch.ones(67)).eval()
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


# HumanAct12 -----------------------------------------------------------------------------------------------------------


@pytest.mark.golden
@needs_third_party
@pytest.mark.parametrize("start", [pytest.param(s, id=f"humanact12_gru-{s or 'given'}") for s in ("", "_h0_zero")])
def test_the_gru_gives_the_authors_features_and_logits(start):
    arrays = third_party("humanact12_gru")
    network = ActionGRU(recenter=False).eval()
    network.load_state_dict(weights(arrays))
    joints = torch.from_numpy(arrays["in/xyz"]).permute(0, 3, 1, 2) * FLIP
    mask = length_mask(torch.from_numpy(arrays["in/lengths"]), joints.shape[1])
    state = None if start else torch.from_numpy(arrays["in/hidden_unit"])
    with torch.no_grad():
        assert_within(network(joints, mask, state), arrays, f"out/features{start}", like="out/features")
        assert_within(network.logits(joints, mask, state), arrays, f"out/logits{start}", like="out/logits")


def test_the_gru_stops_at_the_end_and_starts_at_the_origin():
    torch.manual_seed(0)
    network = ActionGRU().eval()
    joints, lengths = torch.randn(3, 60, 24, 3), torch.tensor([60, 31, 1])
    features = network(joints, length_mask(lengths))
    assert features.shape == (3, network.features)
    assert network.logits(joints, length_mask(lengths)).shape == (3, NUM_ACTIONS)
    alone = network(joints[1:2, :31], torch.ones(1, 31, dtype=torch.bool))
    torch.testing.assert_close(alone[0], features[1], atol=1e-6, rtol=0)
    moved = network(joints + torch.tensor([3.0, -1.0, 2.0]), length_mask(lengths))
    torch.testing.assert_close(moved, features, atol=1e-4, rtol=0)


def test_a_random_start_belongs_to_its_seed():
    network = ActionGRU()
    draw = [network.random_state(4, torch.Generator().manual_seed(seed)) for seed in (0, 0, 1)]
    assert draw[0].shape == (2, 4, 128)
    assert torch.equal(draw[0], draw[1])
    assert not torch.equal(draw[0], draw[2])


# ST-GCN ---------------------------------------------------------------------------------------------------------------

NETWORKS = {"uestc": UESTC, "unconstrained": Unconstrained}


def formula_weights(network: nn.Module) -> None:
    """The fixture's weights, which a formula gives (its `meta.weights`)."""
    state = network.state_dict()
    for number, name in enumerate(sorted(state)):
        value = state[name]
        if name == "A" or name.endswith("num_batches_tracked"):
            continue
        wave = torch.cos(1.3 * number + 0.61803398875 * torch.arange(value.numel(), dtype=torch.float64))
        wave = wave.reshape(value.shape)
        one_sided = name.startswith("edge_importance") or name.endswith("running_var")
        if one_sided or (value.ndim == 1 and name.endswith("weight")):
            state[name] = 1 + 0.1 * wave
        elif value.ndim >= 2:
            state[name] = 1.5 * wave / np.sqrt(np.prod(value.shape[1:]))
        else:
            state[name] = 0.1 * wave
    network.load_state_dict(state)


def stgcn_cases() -> list:
    return [pytest.param(name, id=f"stgcn-{name}") for name in groups(golden("stgcn"), "adjacency_A")]


@pytest.mark.golden
@pytest.mark.parametrize("name", stgcn_cases())
def test_stgcn_gives_the_authors_features_and_logits(name):
    arrays = golden("stgcn")
    network = NETWORKS[name]().eval()
    shapes = {key: list(value.shape) for key, value in network.state_dict().items()}
    assert shapes == meta(arrays)["state_dict_shapes"][name]
    np.testing.assert_allclose(network.A.numpy(), arrays[f"{name}/adjacency_A"], atol=1e-7)
    formula_weights(network)
    x = torch.from_numpy(arrays[f"{name}/x"]).permute(0, 3, 1, 2)
    with torch.no_grad():
        features = STGCN.forward(network, x, torch.ones(x.shape[:2], dtype=torch.bool))
        assert_within(features, arrays, f"{name}/features")
        assert_within(network.fcn(features[..., None, None])[..., 0, 0], arrays, f"{name}/yhat")


@pytest.mark.golden
@pytest.mark.parametrize("name", stgcn_cases())
def test_stgcn_reads_our_motions_as_the_authors_read_theirs(name):
    """The fixture's inputs, given as this project gives motions: 25 x 6 features, or 24 joints with y up."""
    arrays = golden("stgcn")
    network = NETWORKS[name]().eval()
    formula_weights(network)
    x = torch.from_numpy(arrays[f"{name}/x"]).permute(0, 3, 1, 2)
    mask = torch.ones(x.shape[:2], dtype=torch.bool)
    if name == "uestc":
        way = torch.randn(*x.shape[:2], 1, 6)
        assert_within(network(torch.cat([x, way], 2).flatten(2), mask), arrays, f"{name}/features")
    else:
        joints = torch.randn(*x.shape[:2], 24, 3)
        joints[:, :, [15, 12, 16, 18, 20, 17, 19, 21, 0, 1, 4, 7, 2, 5, 8]] = x * FLIP
        seen = x - x[:, :, 8:9]  # from the pelvis
        torch.testing.assert_close(network(joints, mask), STGCN.forward(network, seen, mask), atol=1e-5, rtol=0)
        torch.testing.assert_close(network(joints + 7, mask), network(joints, mask), atol=1e-4, rtol=0)


@pytest.mark.parametrize(("make", "shape", "actions"), [(UESTC, (150,), 40), (Unconstrained, (24, 3), 12)])
def test_stgcn_classifies(make, shape, actions):
    network = make().eval()
    x, mask = torch.randn(2, 16, *shape), torch.ones(2, 16, dtype=torch.bool)
    assert network(x, mask).shape == (2, network.features)
    logits = network.logits(x, mask)
    assert logits.shape == (2, actions)
    torch.testing.assert_close(logits, network(x, mask) @ network.fcn.weight.flatten(1).T + network.fcn.bias)


def small() -> JointSTGCN:
    return JointSTGCN((-1, 0, 1, 0), 5, widths=(4, 6), strides=(1, 2))


@pytest.mark.parametrize(("make", "shape"), [(UESTC, (150,)), (Unconstrained, (24, 3)), (small, (4, 3))])
def test_stgcn_sees_nothing_past_the_end(make, shape):
    torch.manual_seed(0)
    network = make().eval()
    lengths = torch.tensor([20, 13, 1])
    mask, x = length_mask(lengths), torch.randn(3, 20, *shape)
    with torch.no_grad():
        together = network.logits(x, mask)
        for row, length in enumerate(lengths.tolist()):
            alone = network.logits(x[row : row + 1, :length], torch.ones(1, length, dtype=torch.bool))
            torch.testing.assert_close(alone[0], together[row], atol=1e-5, rtol=1e-4)


def test_a_classifier_of_joints_does_not_see_where_the_motion_stands():
    network = small().eval()
    x, mask = torch.randn(2, 9, 4, 3), torch.ones(2, 9, dtype=torch.bool)
    torch.testing.assert_close(network(x + torch.tensor([5.0, 1, -3]), mask), network(x, mask), atol=1e-5, rtol=1e-4)
    way = torch.linspace(0, 1, 9)[:, None, None]
    assert not torch.allclose(network(x + way, mask), network(x, mask), atol=1e-3), "but which way it goes"


# Files ----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("make", "load", "key"),
    [(ActionGRU, load_action_gru, "model"), (UESTC, load_uestc, None), (Unconstrained, load_unconstrained, None)],
    ids=["action_gru", "uestc", "unconstrained"],
)
def test_released_weights_are_loaded_whole_or_not_at_all(tmp_path, make, load, key):
    def write(state):
        torch.save({key: state, "iteration": 3} if key else state, path)

    path = tmp_path / "weights.tar"
    state = make().state_dict()
    write(state)
    loaded = load(path)
    assert not loaded.training
    assert all(torch.equal(value, state[name]) for name, value in loaded.state_dict().items())
    name = next(iter(state))
    write({k: v for k, v in state.items() if k != name})
    with pytest.raises(ValueError, match=rf"weights\.tar: not the weights of {make.__name__}: Missing key.*{name}"):
        load(path)
    write({**state, "extra": torch.zeros(1)})
    with pytest.raises(ValueError, match=r"Unexpected key.*extra"):
        load(path)
    path.write_bytes(path.read_bytes()[:500])
    with pytest.raises(ValueError, match=r"weights\.tar: damaged"):
        load(path)
    with pytest.raises(FileNotFoundError, match=r"absent\.tar: no such file\. Give the path of the weights"):
        load(tmp_path / "absent.tar")


class _Runs:
    def __reduce__(self):
        return (pytest.fail, ("code of the file was run",))


def test_no_code_of_a_released_file_is_run(tmp_path):
    torch.save({"model": _Runs()}, tmp_path / "evil.tar")
    with pytest.raises(ValueError, match=r"evil\.tar: damaged, or it holds objects other than plain weights"):
        load_action_gru(tmp_path / "evil.tar")
