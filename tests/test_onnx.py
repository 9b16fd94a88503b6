"""Export to ONNX: the sampling loop as numbers, graphs of each denoiser, the runner without PyTorch, the web page."""

import http.server
import json
import shutil
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast
from unittest.mock import patch

import numpy as np
import pytest
import torch
from hydra.utils import instantiate
from support.browser import Tab, browser, in_chromium
from support.fixtures import ROOT, recipe, script
from support.glb import Glb
from support.runs import TINY_DIP, untrained
from torch import Tensor

import flame_mdm
from flame_mdm.__main__ import main
from flame_mdm.batch import Condition, MotionBatch, length_mask
from flame_mdm.checkpoints import onnx_export as onnx
from flame_mdm.checkpoints import runner
from flame_mdm.conditions import vocabulary
from flame_mdm.conditions.tokens import LearnedTokens
from flame_mdm.data.standing import standing
from flame_mdm.errors import UserError
from flame_mdm.formats import fbx_scene
from flame_mdm.formats.poses import solve
from flame_mdm.formats.readers import read
from flame_mdm.generator import MotionGenerator, joined
from flame_mdm.processes.diffusion import GaussianDiffusion
from flame_mdm.processes.flow_matching import FlowMatching
from flame_mdm.representations import rotation
from flame_mdm.safe_io import read_package_yaml
from flame_mdm.sampler_options import SamplerOptions
from flame_mdm.sampling.motion_request import USUAL_SECONDS
from flame_mdm.seeds import key, seeded_noise

SIZES = {
    "latent_dim": 16,
    "ff_size": 24,
    "num_layers": 1,
    "num_heads": 2,
    "channels": [8, 16],
    "num_groups": 4,
}
RECIPES = sorted((ROOT / "experiments" / "denoiser").glob("*.yaml"))
# One recipe of each class of denoisers
NETWORKS = {read_package_yaml(path)["_target_"]: path.stem for path in RECIPES}
CONDITIONS = {"MDMEncoder": "action", "MDMUNet": "none"}  # other classes are conditioned on texts
VARIANTS = [
    (name, CONDITIONS.get(target.rpartition(".")[2], "learned"))
    for target, name in NETWORKS.items()
]
VARIANTS += [("mdm_decoder_token", "learned"), ("mfm_encoder_tokens", "learned")]
TEXT = "a person kicks twice with the left leg"
NOTHING = Condition(torch.zeros(1, 0), torch.zeros(1, 0, 0), None)


def network(x_t: Tensor, t: Tensor, *_: Any, width: int = 8) -> Tensor:
    """A denoiser that is not linear, of 4 features and, with `width` 8, a learned variance."""
    return torch.cat([torch.sin(3 * x_t + t[:, None, None]), torch.cos(x_t)], -1)[..., :width]


def followed(plan: list[list[float]], clip: bool, noise: Any) -> Tensor:
    """Motion that the rows of a plan lead to."""
    x, draw, before = noise(0), 1, torch.zeros(())
    for t, of_x, of_output, keep, clean, last, scale in plan:
        x0_hat = of_x * x + of_output * network(x, torch.tensor([t]))[..., : x.shape[-1]]
        x0_hat = x0_hat.clamp(-1, 1) if clip else x0_hat
        x = keep * x + clean * x0_hat + last * before
        if scale:
            x, draw = x + scale * noise(draw), draw + 1
        before = x0_hat
    return x


DIFFUSION = [
    ("ancestral", {}),
    ("ddim", {}),
    ("ddim", {"eta": 0.7}),
    ("dpm_solver_pp_2m", {}),
    ("consistency", {}),
]
FLOW = ("euler", "midpoint", "heun", "consistency")
CASES = [
    *(
        (GaussianDiffusion(50, prediction=p), name, options)
        for p in ("x0", "epsilon")
        for name, options in DIFFUSION
    ),
    (
        GaussianDiffusion(50, prediction="velocity", variance="fixed_large", clip_x0=True),
        "ancestral",
        {},
    ),
    (
        GaussianDiffusion(50, variance="learned_range"),
        "ddim",
        {"spacing": "stride", "num_inference_steps": 10},
    ),
    (GaussianDiffusion(50), "ancestral", {"num_inference_steps": [0, 3, 20, 49]}),
    *((FlowMatching(prediction=p), name, {}) for p in ("velocity", "x0") for name in FLOW),
    (FlowMatching(quantize_time=True, odeint_grid=True), "euler", {}),
]


def test_a_plan_leads_to_the_motion_of_the_sampler(subtests) -> None:
    like, mask = torch.zeros(1, 5, 4, dtype=torch.float64), torch.ones(1, 5, dtype=torch.bool)
    noise = seeded_noise(["a"], 5, 4, seed=1, replication=0, like=like)
    for process, sampler, options in CASES:
        with subtests.test(process=process, sampler=sampler, options=options):
            requested = SamplerOptions(**{"sampler": sampler, "num_inference_steps": 8} | options)
            denoise = partial(network, width=process.out_features(4))
            expected = process.sample(denoise, noise, mask, NOTHING, requested)
            plan = onnx.sampling_plan(process, requested)
            assert np.shape(plan)[1] == 7
            ours = followed(plan, getattr(process, "clip_x0", False), noise)
            torch.testing.assert_close(
                ours, expected, atol=1e-9, rtol=1e-7, msg=f"{process} {requested}"
            )
    for process, sampler, says in (
        (
            GaussianDiffusion(50, variance="learned_range"),
            "ancestral",
            "the variance that this model has learned",
        ),
        (FlowMatching(), "rk4", "combines more than two"),
        (FlowMatching(), "dopri5", "dopri5 does not support edits"),
        (FlowMatching(), "ddim", "unknown sampler"),
    ):
        with subtests.test(sampler=sampler, says=says), pytest.raises(UserError, match=says):
            onnx.sampling_plan(process, SamplerOptions(sampler=sampler, num_inference_steps=6))


def test_noise_and_words_of_the_runner_are_those_of_the_package(subtests) -> None:
    noise = seeded_noise(["a person walks#0"], 60, 263, seed=3, replication=0, like=torch.zeros(1))
    number = runner.key("noise", 3, 0, "a person walks#0")
    assert number == key("noise", 3, 0, "a person walks#0")
    for draw in (0, 1, 49):
        with subtests.test(draw=draw):
            np.testing.assert_allclose(
                runner.normal(number + draw, 60, 263), noise(draw)[0].numpy(), atol=2e-6
            )
    text = "Él kicks, twice: a_b don't"
    assert runner.words(text) == vocabulary.words(text)
    assert all(
        runner.hashed(word, 97) == vocabulary.hashed(word, 97) for word in runner.words(text)
    )


def test_forms_of_words_of_the_runner_are_those_of_the_package() -> None:
    stems = ("walk", "wave", "hop", "kick", "punch", "dance", "carry", "two", "is", "agree", "stop")
    endings = ("", "e", "s", "es", "ing", "ed", "d", "ping", "ped", "ning")
    spoken = sorted({stem + ending for stem in stems for ending in endings} | runner.NUMBERS)
    for seen in (
        {"walks", "wave", "hops", "two", "kicked"},
        {"waving", "hopping", "twos", "eights"},
    ):
        for word in spoken:
            assert runner.known_form(word, seen) == vocabulary.known_form(word, seen), word
    assert frozenset(vocabulary.NUMBERS) == runner.NUMBERS


@pytest.mark.parametrize("fade", [1, 4, 9])
def test_blocks_of_the_runner_are_joined_as_those_of_the_package(fade: int) -> None:
    before, x = torch.randn(5, 6, generator=torch.Generator().manual_seed(fade)).split([2, 3])
    expected = joined(before[None], x[None], fade)[0].numpy()
    ours = runner.joined(before.numpy(), x.numpy(), {"frames": fade, "begin": 2, "end": 5})
    np.testing.assert_allclose(ours[:, 2:5], expected[:, 2:5], atol=1e-6)
    np.testing.assert_array_equal(ours[:, [0, 1, 5]], x.numpy()[:, [0, 1, 5]])
    np.testing.assert_array_equal(runner.joined(before.numpy(), x.numpy(), None), x.numpy())


def sampler_without_graphs(**content: Any) -> runner.Sampler:
    """A runner whose denoiser predicts 0, for 10 features at 20 frames per second."""
    sampler = object.__new__(runner.Sampler)
    sampler.content = {
        "reads": "none", "fps": 20, "features": 10, "max_frames": 200, "padded_frames": 0,
        "clip_x0": False, "steps": [[0, 0, 0, 1, 0, 0, 0]], **content,
    }  # fmt: skip
    sampler._run = lambda name, inputs, shapes: [np.zeros(shapes[0], np.float32)]  # type: ignore[method-assign]
    return sampler


@pytest.mark.parametrize(("seconds", "frames"), [
    (None, 60), (1.24, 25), (1.26, 25), (1.28, 26), (0.1, 2), (10.0, 200)
])  # fmt: skip
def test_the_runner_rounds_seconds_to_frames(seconds: float | None, frames: int) -> None:
    assert runner.USUAL_SECONDS == USUAL_SECONDS, "the package has the same default"
    assert len(sampler_without_graphs().generate(seconds=seconds)) == frames
    padded = sampler_without_graphs(padded_frames=200, max_frames=200)
    assert len(padded.generate(seconds=seconds)) == frames


def test_the_runner_states_the_shortest_and_the_longest_motion() -> None:
    for seconds in (0.05, 10.1, -1.0, float("inf")):
        with pytest.raises(ValueError, match=r"give 0\.1 to 10 seconds"):
            sampler_without_graphs().generate(seconds=seconds)
    assert len(sampler_without_graphs(max_frames=40).generate()) == 40
    start = {"start": [[0.0] * 10] * 20, "max_frames": 60}
    with pytest.raises(ValueError, match=r"give 0\.1 to 600 seconds"):
        sampler_without_graphs(**start).generate(seconds=600.1)
    assert len(sampler_without_graphs(**start).generate(seconds=4.5)) == 90


def test_the_root_of_a_model_in_other_units_moves_in_radians_and_meters() -> None:
    representation = SimpleNamespace(
        mean=torch.tensor([1.0, 320.0, 640.0, 9.0]),
        std=torch.tensor([2.0, 64.0, 6.4, 9.0]),
        turn_unit=0.5,
        units_per_metre=640.0,
    )
    units = onnx.root_units(cast(Any, representation))
    np.testing.assert_allclose(units, [[0.5, 1.0], [0.5, 0.1], [1.0, 0.01]], rtol=1e-6)


def test_an_export_compares_the_same_inputs_each_time_and_leaves_the_random_state(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    drawn: list[Tensor] = []

    def collect(graph: onnx.Graph, path: Path, half: bool) -> None:
        drawn.extend(value.double() for value in graph.examples.values())
        path.write_bytes(b"")

    monkeypatch.setattr(onnx, "write_graph", collect)
    model = flame_mdm.load("quickstart")
    for number, seed in enumerate((1, 2)):
        torch.manual_seed(seed)
        state = torch.get_rng_state()
        onnx.write_folder(model, tmp_path / str(number))
        assert torch.equal(torch.get_rng_state(), state)
    first, second = drawn[: len(drawn) // 2], drawn[len(drawn) // 2 :]
    assert all(torch.equal(a, b) for a, b in zip(first, second, strict=True))


def test_the_runner_draws_the_noise_of_a_sentence_for_another_caption() -> None:
    passes = {"steps": [[0, 0, 0, 1, 0, 0, 0]], "reads": "none"}
    as_typed = sampler_without_graphs(**passes).generate("typed")
    read = sampler_without_graphs(**passes).generate("caption", text="typed")
    np.testing.assert_array_equal(read, as_typed)
    assert not np.array_equal(sampler_without_graphs(**passes).generate("caption"), as_typed)


@pytest.mark.parametrize("clip", [False, True])
def test_a_step_of_the_runner_combines_noise_and_the_last_two_clean_estimates(clip: bool) -> None:
    """A row of the plan contains t, p, q, a, b, c and d; the denoiser returns 5 t."""
    steps = [[3, 0.5, 0.2, 0.25, 3, 7, 0.1], [2, 0, 0.3, 0.5, 0.25, 4, 0], [1, 0, 0.1, 1, 1, 2, 2]]
    sampler, times = sampler_without_graphs(clip_x0=clip, steps=steps, features=3), list[float]()

    def run(name: str, inputs: dict[str, np.ndarray], shapes: Any) -> list[np.ndarray]:
        times.extend(inputs["t"].tolist())
        return [np.full(shapes[0], 5 * inputs["t"][0], np.float32)]

    sampler._run = run  # type: ignore[method-assign]
    x, before, draws = runner.normal(11, 4, 3), np.zeros((4, 3)), 0
    for t, p, q, a, b, c, d in steps:
        clean = p * x + q * 5 * t
        clean = clean.clip(-1, 1) if clip else clean
        x = a * x + b * clean + c * before
        if d:
            draws += 1
            x = x + d * runner.normal(11 + draws, 4, 3)
        before = clean
    np.testing.assert_allclose(sampler._sample({}, 4, 11), x, rtol=1e-5)
    assert times == [3, 2, 1]


@pytest.mark.parametrize("words", [["a", "jumps", "walks"], []])
def test_the_runner_reads_the_words_that_the_package_reads(words: list[str]) -> None:
    encoder = LearnedTokens(8, buckets=50, max_words=4, heads=2)
    encoder.seen = set(words)
    sampler = sampler_without_graphs(reads="text", buckets=50, max_words=4, vocabulary=words)
    for text in ("", "Walked", "a man walks", "a jumping man walks and jumps, walks again"):
        rows, condition = encoder.rows(text), sampler._condition(text)
        assert condition["counts"].tolist() == [len(rows)]
        padding = [(0, 0)] * (3 - len(rows))
        assert [tuple(row) for row in condition["condition"][0].tolist()] == [*rows, *padding]


def test_unknown_content_words_are_named_once_and_a_text_without_a_known_one_is_refused() -> None:
    functions = ["a", "person", "then"]
    sampler = sampler_without_graphs(vocabulary=["a", "walks", "wave"], function_words=functions)
    assert sampler.unknown("a person walked, then backflips and waves") == ["backflips", "and"]
    assert sampler.unknown("Zigzag walks: ZIGZAG, hop") == ["zigzag", "hop"]
    assert sampler.unknown("walking") == []
    for text in ("a person backflips", "hops and hops", "a person", ""):
        with pytest.raises(ValueError, match="the model knows no word for an action in this text"):
            sampler.unknown(text)
    without_words = sampler_without_graphs(vocabulary=[], function_words=functions)
    assert without_words.unknown("a person backflips") == []


@pytest.mark.parametrize(
    ("fps", "options", "seconds", "seed", "frames"),
    [
        (12.5, [], None, 0, 38),
        (20, ["seed=7"], None, 7, 60),
        (30, ["seconds=1.5", "seed=-1"], 1.5, -1, 45),
        (59.94, ["seconds=2"], 2.0, 0, 120),
    ],
)
def test_the_runner_writes_one_motion_and_says_how_long_it_is(
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    fps: float,
    options: list[str],
    seconds: float | None,
    seed: int,
    frames: int,
) -> None:
    steps = [[0, 0, 0, 1, 0, 0, 0]]  # the motion is its noise
    sampler = sampler_without_graphs(fps=fps, features=3, steps=steps, vocabulary=["seed", "walks"])
    sampler.content["function_words"] = []
    monkeypatch.setattr(sampler, "decode", lambda x: x[:, None])
    monkeypatch.setattr(runner, "Sampler", lambda folder: sampler)
    text, out = "Seed= walks oddly", tmp_path / "walk.v2"
    assert runner.main(["model", text, str(out), *options]) == 0
    printed = capsys.readouterr()
    assert printed.out == (
        f"warning: never seen in training: oddly\n{out}.npz: {frames} frames at {fps:g} "
        "frames per second, joints in meters, y up\n"
    )
    assert printed.err == ""
    assert [path.name for path in tmp_path.iterdir()] == ["walk.v2.npz"]
    with np.load(tmp_path / "walk.v2.npz") as file:
        assert sorted(file) == ["fps", "joints", "text"]
        assert (float(file["fps"]), str(file["text"])) == (fps, text)
        expected = sampler.generate(text, seconds, seed)[:, None]
        np.testing.assert_array_equal(file["joints"], expected)
        assert file["joints"].shape == (frames, 1, 3)


@pytest.mark.parametrize(
    "words", [[], ["model"], ["model", "walks"], ["model", "walks", "out.npz", "3"]]
)
def test_the_runner_explains_its_words_if_their_number_is_wrong(
    words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert runner.main([*words, "seconds=2"]) == 2
    usage = 'usage: python runner.py FOLDER "TEXT OR ACTION" motion.npz [seconds=3] [seed=0]\n'
    assert capsys.readouterr().err == usage


def test_an_unknown_action_is_refused_with_the_known_ones_and_others_have_their_number() -> None:
    sampler = sampler_without_graphs(reads="action", actions=["walk", "sit down", "jump"])
    numbers = [
        sampler._condition(name)["condition"].tolist() for name in sampler.content["actions"]
    ]
    assert numbers == [[0], [1], [2]]
    with pytest.raises(
        ValueError, match="unknown action 'Walk'; this model knows: walk, sit down, jump"
    ):
        sampler.generate("Walk")


def test_blocks_of_the_runner_continue_the_last_frames_with_noise_of_their_own() -> None:
    """The denoiser predicts 0, and the only step keeps the noise of a block."""
    start = np.arange(20.0).reshape(2, 10)
    steps = [[0, 0, 0, 1, 0, 0, 0]]
    for seconds, count in ((0.3, 2), (0.4, 2), (0.45, 3), (0.15, 1)):
        sampler = sampler_without_graphs(start=start.tolist(), max_frames=6, steps=steps)
        read: list[dict[str, np.ndarray]] = []

        def run(
            name: str, inputs: dict[str, np.ndarray], shapes: Any, read: Any = read
        ) -> list[np.ndarray]:
            read.append(inputs)
            return [np.zeros(shapes[0], np.float32)]

        sampler._run = run  # type: ignore[method-assign]
        x = sampler.generate("a", seconds, seed=4, sample=2)
        names = [f"a#2\x1f{number}" for number in range(count)]
        blocks = [runner.normal(runner.key("noise", 4, 0, name), 4, 10) for name in names]
        whole = np.concatenate([start, *blocks])
        np.testing.assert_allclose(x, whole[2 : 2 + round(20 * seconds)], rtol=1e-6)
        assert [inputs["lengths"].tolist() for inputs in read] == [[4]] * count
        for number, inputs in enumerate(read):
            np.testing.assert_allclose(inputs["prefix"][0], whole[4 * number : 4 * number + 2])


def test_noise_of_the_runner_depends_on_prompt_sample_and_seed() -> None:
    passes = {"steps": [[0, 0, 0, 1, 0, 0, 0]]}  # the last step keeps the noise
    first = sampler_without_graphs(**passes).generate("a")
    np.testing.assert_array_equal(sampler_without_graphs(**passes).generate("a"), first)
    changes: list[dict[str, Any]] = [{"prompt": "b"}, {"sample": 1}, {"seed": 1}]
    for others in changes:
        other = sampler_without_graphs(**passes).generate(**cast(Any, {"prompt": "a"} | others))
        assert np.abs(other - first).max() > 0.5, others
    expected = seeded_noise(["a#0"], 60, 10, seed=0, replication=0, like=torch.zeros(1))(0)
    np.testing.assert_allclose(first, expected[0].numpy(), atol=2e-6)


@pytest.fixture(scope="module", autouse=True)
def poses_written_once(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Most of the time of an export goes into the graph of the poses, which does not depend on the model."""
    write, shared = onnx.write_graph, tmp_path_factory.mktemp("poses") / "poses.onnx"

    def write_once(graph: onnx.Graph, path: Path, half: bool) -> None:
        if graph.name != "poses":
            return write(graph, path, half)
        if not shared.exists():
            write(graph, shared, half)
        shutil.copy(shared, path)
        return None

    with patch.object(onnx, "write_graph", write_once):
        yield


def tiny(name: str, condition: str) -> MotionGenerator:
    """A model with random weights."""
    config = dict(recipe("quickstart"))
    denoiser: Any = read_package_yaml(ROOT / "experiments" / "denoiser" / f"{name}.yaml")
    config["denoiser"] = denoiser | {key: value for key, value in SIZES.items() if key in denoiser}
    target = {
        "learned": "tokens.LearnedTokens",
        "action": "action.ActionLabels",
        "none": "Unconditional",
    }[condition]
    sizes = {
        "learned": {"features": 16, "buckets": 50, "max_words": 8},
        "action": {"features": 16},
        "none": {},
    }
    config["condition"] = {"_target_": f"flame_mdm.conditions.{target}", **sizes[condition]}
    config["representation"] = {"_target_": "flame_mdm.representations.essential.Essential"}
    torch.manual_seed(0)
    model = MotionGenerator.build(
        config, instantiate(config["representation"]), actions=["walk", "run", "sit"]
    )
    model.facts |= {"max_frames": 20}
    return model.eval()


def inputs_of(
    model: MotionGenerator, condition: str, batch: int, frames: int, words: int
) -> dict[str, Tensor]:
    """Random inputs of the graph of a denoiser."""
    inputs = {
        "x_t": torch.randn(batch, frames, model.representation.features),
        "t": torch.rand(batch) * 999,
        "lengths": torch.randint(2, frames + 1, (batch,)),
    }
    if condition == "learned":
        inputs["condition"] = torch.randint(50, (batch, words, 2))
        inputs["counts"] = torch.randint(1, words + 1, (batch,))
    elif condition == "action":
        inputs["condition"] = torch.arange(batch)
    return inputs


def assert_computes(
    run: Callable[[dict[str, Tensor]], Tensor], graph: onnx.Graph, model: MotionGenerator, kind: str
) -> None:
    """`run` computes what the module of a graph does, for batches and lengths other than those it was made with."""
    for batch, frames, words in ((1, 4, 3), (3, 17, 9)):
        frames = 20 if isinstance(model.denoiser, onnx.FIXED_LENGTH) else frames
        inputs = inputs_of(model, kind, batch, frames, words)
        mask = length_mask(inputs["lengths"], frames)
        expected = graph.module(*inputs.values())
        torch.testing.assert_close(run(inputs)[mask], expected[mask], atol=1e-4, rtol=1e-4)


@pytest.mark.filterwarnings("ignore:The tensor attributes")  # of PyTorch's own GRU
@pytest.mark.parametrize(("name", "condition"), VARIANTS)
def test_each_denoiser_is_traced_for_inputs_of_any_size(name: str, condition: str) -> None:
    """The first part of an export, in which the code of a denoiser can fail; the others take much longer."""
    model = tiny(name, condition)
    graph = onnx.graphs(model)[0]
    with torch.no_grad():
        traced = onnx.traced(graph).module()
        assert_computes(lambda inputs: traced(*inputs.values()), graph, model, condition)


@pytest.mark.robustness
@pytest.mark.parametrize(("name", "condition"), VARIANTS)
def test_graphs_of_each_denoiser_compute_what_pytorch_does(
    name: str, condition: str, tmp_path: Path
) -> None:
    import onnxruntime

    model = tiny(name, condition)
    graph = onnx.graphs(model)[0]
    with torch.no_grad():
        onnx.write_graph(graph, tmp_path / "denoiser.onnx", half=False)
        session = onnxruntime.InferenceSession(tmp_path / "denoiser.onnx")

        def run(inputs: dict[str, Tensor]) -> Tensor:
            values = {name: x.numpy() for name, x in inputs.items()}
            return torch.from_numpy(session.run(None, values)[0])

        assert_computes(run, graph, model, condition)


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_the_runner_samples_the_motions_of_the_package_without_pytorch_and_refuses_a_changed_folder(
    trained: Path, tmp_path: Path, capfd: Any, subtests
) -> None:
    exported, out = tmp_path / "model", tmp_path / "out.npz"
    assert main(["export", str(trained), str(exported), "format=onnx", "half=true"]) == 0
    model = flame_mdm.load(trained)
    words = [str(exported), TEXT, str(out), "seconds=2.2", "seed=1"]
    script = f"import sys, runpy; sys.argv = ['runner.py', *{words}]; sys.modules['torch'] = None\n"
    script += f"runpy.run_path({str(exported / 'runner.py')!r}, run_name='__main__')"
    assert subprocess.run([sys.executable, "-I", "-c", script], check=False).returncode == 0
    motion = flame_mdm.generate(model, TEXT, seconds=2.2, seed=1)[0]
    with np.load(out) as file:
        assert np.abs(file["joints"] - motion.joints).max() < 1e-3
    sampler = runner.Sampler(exported)
    offsets, quaternions = sampler.rotations(motion.joints)
    poses = solve(torch.from_numpy(motion.joints), motion.fps)
    np.testing.assert_allclose(offsets, poses.offsets.numpy(), atol=1e-5)
    matrices = rotation.quaternion_to_matrix(torch.from_numpy(quaternions))
    torch.testing.assert_close(matrices.double(), poses.rotations, atol=2e-3, rtol=0)
    assert sampler.unknown("a person walks backflipping") == ["backflipping"]
    for seconds in (9, 0):
        with (
            subtests.test(seconds=seconds),
            pytest.raises(ValueError, match=r"give 0\.1 to 3 seconds"),
        ):
            sampler.generate(TEXT, seconds)

    description, graph = ((exported / name).read_bytes() for name in ("model.json", "joints.onnx"))
    capfd.readouterr()
    for name, content, says in (
        ("model.json", description[:-9], "not an exported model"),
        (
            "model.json",
            description.replace(b'"format": 1', b'"format": 2'),
            "does not have format 1",
        ),
        (
            "model.json",
            description.replace(b'"fps": 20', b'"fps": 0'),
            "model.json has changed since it was exported",
        ),
        ("joints.onnx", graph[:-9] + b"x" * 9, "joints.onnx has changed since it was exported"),
    ):
        with subtests.test(name=name, content=content, says=says):
            (exported / "model.json").write_bytes(description)
            (exported / name).write_bytes(content)
            assert runner.main([str(exported), "walk", str(out)]) == 1
            assert says in (error := capfd.readouterr().err)
            assert error.count("\n") == 1


@pytest.fixture(scope="module")
def continuing() -> MotionGenerator:
    """A tiny model that continues 10 frames by 30, with random weights."""
    model = untrained(TINY_DIP, 40, "synthetic/dip")
    model.representation.std.fill_(0.05)
    return model


def test_a_model_that_continues_frames_is_traced_with_them_as_an_input(
    continuing: MotionGenerator,
) -> None:
    graph = onnx.graphs(continuing)[0]
    assert list(graph.examples) == ["x_t", "t", "lengths", "prefix", "condition", "counts"]
    with torch.no_grad():
        traced = onnx.traced(graph).module()
        inputs = {name: example[:1] for name, example in graph.examples.items()}
        expected = graph.module(*inputs.values())
        torch.testing.assert_close(traced(*inputs.values()), expected, atol=1e-4, rtol=1e-4)
        inputs["prefix"] = inputs["prefix"] + 1
        assert (traced(*inputs.values()) - expected).abs().max() > 1e-3


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_the_runner_continues_frames_as_the_package_does(
    continuing: MotionGenerator, tmp_path: Path, subtests
) -> None:
    onnx.write_folder(continuing, tmp_path / "model")
    sampler = runner.Sampler(tmp_path / "model")
    for seconds, seed in ((0.5, 0), (4.2, 3)):
        with subtests.test(seconds=seconds, seed=seed):
            motion = flame_mdm.generate(continuing, TEXT, seconds=seconds, seed=seed)[0]
            joints = sampler.decode(sampler.generate(TEXT, seconds, seed))
            assert np.abs(joints - motion.joints).max() < 1e-3
    with pytest.raises(ValueError, match=r"give 0\.1 to 600 seconds"):
        sampler.generate(TEXT, 601)


@pytest.mark.parametrize(("fps", "frames"), [(20.0, 10), (25.0, 12), (30.0, 15), (59.94, 30)])
def test_a_description_has_the_start_the_fade_and_the_root_of_a_model_that_continues_frames(
    monkeypatch: pytest.MonkeyPatch, continuing: MotionGenerator, fps: float, frames: int
) -> None:
    representation = continuing.representation
    mean = torch.arange(263.0) / 100
    monkeypatch.setattr(representation, "fps", fps)
    monkeypatch.setitem(representation._buffers, "mean", mean)
    content = onnx.description(continuing)
    still = torch.from_numpy(standing(representation, 10).features)
    assert len(content["start"]) == 10
    np.testing.assert_allclose(content["start"], (still - mean) / 0.05, rtol=1e-5, atol=1e-5)
    # The pose consists of the height of the root, the positions and the rotations
    assert content["fade"] == {"frames": frames, "begin": 3, "end": 4 + 9 * 21}
    np.testing.assert_allclose(content["root"], [[0, 0.05], [0.01, 0.05], [0.02, 0.05]], atol=1e-7)
    assert (content["fps"], content["max_frames"], content["padded_frames"]) == (fps, 40, 0)


@pytest.mark.parametrize(
    ("name", "options", "padded"),
    [
        ("mdm_encoder_small", {}, 0),
        ("mdm_encoder_small", {"mask_padding": False}, 20),
        ("mdm_gru", {}, 20),
        ("mdm_unet_small", {}, 20),
    ],
)
def test_models_that_need_all_frames_are_padded_and_actions_keep_their_order(
    name: str, options: dict[str, Any], padded: int
) -> None:
    model = tiny(name, "action")
    for option, value in options.items():
        setattr(model.denoiser, option, value)
    model.process = GaussianDiffusion(50, clip_x0=padded == 0)
    content = onnx.description(model)
    assert content["padded_frames"] == padded
    assert content["actions"] == ["walk", "run", "sit"]
    assert content["clip_x0"] == (padded == 0)
    assert not {"start", "fade", "root", "buckets", "max_words"} & set(content)
    words = onnx.description(tiny("mdm_encoder_small", "learned"))
    assert (words["buckets"], words["max_words"], words["reads"]) == (50, 8, "text")


@pytest.mark.parametrize("condition", ["learned", "action", "none"])
@pytest.mark.parametrize("scale", [0.0, 1.0, 2.5])
def test_a_call_is_the_denoiser_with_the_default_guidance_and_without_a_learned_variance(
    condition: str, scale: float
) -> None:
    model = tiny("mdm_encoder_small", condition)
    width = model.representation.features
    model.sampler_options = replace(model.sampler_options, guidance_scale=scale)
    inputs = inputs_of(model, condition, 3, 9, 4)
    mask = length_mask(inputs["lengths"], 9)
    x_t, t = inputs["x_t"], inputs["t"]
    with torch.no_grad():
        actual = onnx.Call(model)(*inputs.values())
        if condition == "learned":
            encoder = cast(LearnedTokens, model.condition)
            cond = encoder.encode(inputs["condition"], inputs["counts"])
        else:
            batch = MotionBatch(x_t, mask, ["a", "b", "c"], action=inputs.get("condition"))
            cond = model.condition(batch)
        expected = model.denoiser(x_t, t, mask, cond)
        if condition != "none":
            null = model.denoiser(x_t, t, mask, cond.drop(torch.ones(3) > 0))
            assert (expected - null).abs().max() > 1e-4
            expected = null + scale * (expected - null)
        torch.testing.assert_close(actual, expected, atol=1e-5, rtol=1e-5)
        assert actual.shape == (3, 9, width)


def test_a_model_beyond_the_limits_of_the_runner_is_not_exported() -> None:
    model = tiny("mdm_encoder_small", "learned")
    assert onnx.description(model)["max_frames"] == 20
    model.facts |= {"max_frames": 20_000}
    with pytest.raises(UserError, match="max_frames: outside the limits for exported models"):
        onnx.description(model)


def test_models_with_a_language_model_and_unknown_formats_are_refused(
    refused: Any, tmp_path: Path
) -> None:
    refused("export", "quickstart", str(tmp_path / "x"), "format=tflite", says="format=tflite: ")
    model = tiny("mdm_encoder_small", "learned")
    model.condition = torch.nn.Module()  # type: ignore[assignment]
    model.condition.features, model.condition.reads = 16, "text"  # type: ignore[union-attr]
    with pytest.raises(UserError, match="language models cannot be exported"):
        onnx.graphs(model)


# The page that samples in the browser, built by tools/web.py and driven in Chromium ----------------------------------

DONE = "document.body?.dataset.made || document.querySelector('#notes.error')?.textContent"


class Handler(http.server.SimpleHTTPRequestHandler):
    extensions_map = http.server.SimpleHTTPRequestHandler.extensions_map | {
        ".mjs": "text/javascript"
    }


@pytest.fixture(scope="module")
def gliding() -> MotionGenerator:
    """A tiny model with random weights that reads the words of the package's model; the person glides forward."""
    model = untrained(TINY_DIP, 40, "synthetic/dip")
    model.add_facts(flame_mdm.load("quickstart").facts | {"max_frames": 40})
    still = standing(model.representation, 10).features[0]
    model.representation.mean.copy_(torch.from_numpy(still))
    model.representation.mean[2] = 0.05
    model.representation.std.fill_(0.01)
    return model


@pytest.fixture(scope="module")
def folder(gliding: MotionGenerator, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("web") / "page"
    script("tools/web.py").build(flame_mdm.load("quickstart"), out, gliding)
    return out


@pytest.fixture
def served(folder: Path, tmp_path: Path) -> Iterator[tuple[Path, str]]:
    """A copy of the page that a test may damage, and its address."""
    copy = shutil.copytree(folder, tmp_path / "page")
    handler = partial(Handler, directory=str(copy))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield copy, f"http://127.0.0.1:{server.server_port}/"
        server.shutdown()


def of_page(test: Any) -> Any:
    built = pytest.mark.skipif(shutil.which("npm") is None, reason="needs npm")
    return in_chromium(pytest.mark.slow(pytest.mark.timeout(900)(built(test))))


def made(tab: Tab) -> dict[str, Any]:
    return json.loads(tab.wait(DONE, 120))


@of_page
def test_the_page_samples_the_motions_of_the_package(
    served: tuple[Path, str], tmp_path: Path, subtests
) -> None:
    folder, url = served
    assert sum(p.stat().st_size for p in folder.iterdir() if p.is_file()) <= 8e6
    model = flame_mdm.load("quickstart")
    with browser(tmp_path / "profile") as tab:
        tab.send("Page.setDownloadBehavior", behavior="allow", downloadPath=str(tmp_path))
        tab.open(f"{url}#text={TEXT}&seconds=2.2&seed=2")
        assert made(tab)["seed"] == "2"
        for seed in (0, 1, 2):
            with subtests.test(seed=seed):
                tab.run("delete document.body.dataset.made")
                tab.type("#seed", str(seed))
                tab.click("#generate")
                assert made(tab) | {"milliseconds": 0} == {
                    "text": TEXT,
                    "seed": str(seed),
                    "milliseconds": 0,
                }
                expected = flame_mdm.generate(model, TEXT, seconds=2.2, seed=seed)[0]
                joints = np.array(tab.run("joints()")).reshape(expected.joints.shape)
                assert np.abs(joints - expected.joints).max() < 1e-3
        file = tmp_path / "a-person-kicks-twice-with-the-left-leg.glb"
        for ending in ("bvh", "glb", "fbx"):
            expected.save(tmp_path / f"python.{ending}")
            tab.click(f"#{ending}")
            while not file.with_suffix(f".{ending}").exists():  # until the time of the test is up
                tab.run("new Promise((done) => setTimeout(done, 50))")
        theirs, ours = read(file.with_suffix(".bvh")), read(tmp_path / "python.bvh")
        assert theirs.fps == pytest.approx(ours.fps)
        assert np.abs(theirs.joints - ours.joints).max() < 1e-3
        theirs, ours = (
            Glb(path).worlds()[:, :22, :3, 3] for path in (file, tmp_path / "python.glb")
        )
        # The body of the page has the proportions of one example, so that its joints differ a little.
        assert np.abs(theirs - ours).max() < 0.01
        theirs, ours = (
            fbx_scene.read(path) for path in (file.with_suffix(".fbx"), tmp_path / "python.fbx")
        )
        assert theirs.names == ours.names
        assert np.abs(theirs.positions - ours.positions).max() < 1e-3
        assert "seed=2" in tab.run("location.hash")
        assert tab.errors == []
        assert [
            address for address in tab.requested if not address.startswith((url, "blob:", "data:"))
        ] == []


CHIPS = "[...document.querySelectorAll('#understood select')].map((e) => e.selectedOptions[0].textContent)"
NOTES = "document.getElementById('notes').innerText"


def typed(tab: Tab, text: str) -> None:
    """Types a text, presses Generate, and waits for the motion or the refusal."""
    tab.run("delete document.body.dataset.made; document.getElementById('notes').className = ''")
    tab.type("#text", text)
    tab.click("#generate")
    tab.wait(DONE, 120)


@of_page
def test_the_page_shows_what_was_understood(served: tuple[Path, str], tmp_path: Path) -> None:
    with browser(tmp_path / "profile") as tab:
        tab.open(f"{served[1]}#seconds=1")
        made(tab)
        typed(tab, "a persn kiks twice with teh left leg sparkly")
        assert tab.run(CHIPS) == ["kicks", "any speed", "twice", "left"]
        assert "'kiks' is read as 'kicks'" in tab.run(NOTES)
        assert tab.run("document.querySelector('#understood del').textContent") == "sparkly"

        tab.run("delete document.body.dataset.made")
        choose = "e.selectedIndex = [...e.options].findIndex((o) => o.textContent === 'right')"
        tab.run(
            "((e) => { " + choose + "; e.dispatchEvent(new Event('change')) })"
            "(document.querySelector('#understood select[aria-label=Side]'))"
        )
        assert made(tab)["text"] == "a person kicks twice with the right leg"
        assert tab.run(CHIPS)[-1] == "right"

        typed(tab, "a man walks backwards, then he waves")
        assert [word for word in tab.run(CHIPS) if not word.startswith("any ")][:3] == [
            "walks",
            "backward",
            "waves",
        ]
        assert "one action at a time" in tab.run(NOTES)

        typed(tab, "a man swims")
        assert "the model does not know 'swims'. Nearest in meaning:" in tab.run(NOTES)
        assert tab.run("document.querySelectorAll('#notes button img').length") == 3
        tab.run("delete document.body.dataset.made")
        tab.click("#notes button")
        assert made(tab)["text"].startswith("a person ")

        typed(tab, "ein Mann geht nach links")
        assert "only English prompts" in tab.run(NOTES)
        assert tab.run(CHIPS) == []
        assert tab.errors == []


@of_page
@pytest.mark.parametrize(
    ("file", "change", "says"),
    [
        (
            "denoiser.onnx",
            lambda data: data[:-9] + b"x" * 9,
            "denoiser.onnx has changed since it was exported",
        ),
        ("model.json", lambda data: data[:-9], "model.json is damaged: not JSON"),
        (
            "model.json",
            lambda data: data.replace(b"[[49.0,", b"[[49.0, 1,"),
            "model.json is damaged: steps",
        ),
        ("figure.json", lambda data: data[:-9], "figure.json is damaged"),
    ],
)
def test_a_damaged_page_says_so_in_one_line(
    served: tuple[Path, str], tmp_path: Path, file: str, change: Any, says: str
) -> None:
    folder, url = served
    (folder / file).write_bytes(change((folder / file).read_bytes()))
    with browser(tmp_path / "profile") as tab:
        tab.open(url)
        assert says in tab.wait(DONE, 60)


@of_page
def test_the_length_in_a_link_is_checked(served: tuple[Path, str], tmp_path: Path) -> None:
    with browser(tmp_path / "profile") as tab:
        tab.open(f"{served[1]}#seconds=1e9")
        assert tab.wait(DONE, 60) == "seconds=1000000000: give 0.1 to 3 seconds"


# The page of a stream -------------------------------------------------------------------------------------------------

STREAM_TEXTS = ("a person waves with the right hand", "a person sits down", "a person jumps")
RECORD = """
window.requests = []
const { source } = live, { block } = source
source.block = (request) => { requests.push(request); return block(request) }
"""


def streamed(model: MotionGenerator, first: str, requests: list[dict[str, Any]]) -> np.ndarray:
    """Returns the joints (F, J, 3) of a stream of the package that gets the requests of the page after the first."""
    running = flame_mdm.stream(model, first, seed=5)
    joints = next(running).joints
    for request in requests:
        running.lead(request["path"])
        running.go_back(request["from"] / 20)
        running.change(request["text"])
        joints = np.concatenate([joints[: request["from"]], next(running).joints])
    return joints


def click_floor(tab: Tab, right: float, down: float) -> None:
    """Clicks in the player, at shares of its width and height."""
    rectangle = "(r => [r.x, r.y, r.width, r.height])(document.querySelector('#live iframe').getBoundingClientRect())"
    x, y, width, height = tab.run(rectangle)
    for kind in ("mousePressed", "mouseReleased"):
        place = {"x": x + right * width, "y": y + down * height}
        tab.send("Input.dispatchMouseEvent", type=kind, button="left", clickCount=1, **place)


@of_page
def test_the_page_streams_the_motion_of_the_package_while_texts_are_typed(
    gliding: MotionGenerator, served: tuple[Path, str], tmp_path: Path
) -> None:
    with browser(tmp_path / "profile") as tab:
        tab.send("Page.setDownloadBehavior", behavior="allow", downloadPath=str(tmp_path))
        tab.open(f"{served[1]}live.html#seed=5")
        failed = "document.querySelector('#status.error')?.textContent"
        assert tab.wait(f"document.body?.dataset.ready || {failed}", 120) == "true"
        first = tab.run(f"{RECORD}; live.page.read(live.text)")
        for number, text in enumerate(STREAM_TEXTS):
            before = tab.run("joints().slice(0, live.frame + 1)")
            tab.type("#live input", text)
            tab.click("#live form button")
            tab.wait(f"live.log[{number}]?.shown", 60)
            assert tab.run(f"joints().slice(0, {len(before)})") == before, "shown frames stay"
        tab.type("#live input", "xyzzy plugh")
        tab.click("#live form button")
        said = "document.querySelector('#live p').textContent"
        assert "no word says what happens" in tab.wait(said)
        tab.type("#live input", "the shelf")
        tab.click("#live form button")
        tab.wait(f"{said}.includes('Nearest in meaning')")
        chips = "[...document.querySelectorAll('.texts button')].map((e) => e.textContent)"
        assert tab.run(chips)[:3] == list(STREAM_TEXTS[::-1])

        # The person goes to a waypoint, which is drawn until then, and stops.
        click_floor(tab, 0.4, 0.9)
        tab.wait("live.text === live.page.walk && live.points.length === 1")
        tab.wait("!live.points.length && live.text === live.page.text", 60)
        assert tab.run("requests.some(({ path }) => path.length)")

        # Frames do not run out.
        tab.run("live.clock.slowest = 1; void 0")
        begin = tab.run("live.frame")
        tab.wait(f"live.frame > {begin + 120}", 60)
        assert tab.run("live.clock.slowest") > 0.5

        tab.click("#live .pause")
        tab.wait("!live.busy && live.clock.paused")
        requests, shown = tab.run("requests"), np.array(tab.run("joints()")).reshape(-1, 22, 3)
        expected = streamed(gliding, first, requests)
        assert shown.shape == expected.shape
        assert np.abs(shown - expected).max() < 0.002
        plain = streamed(gliding, first, [request | {"text": first} for request in requests])
        assert np.abs(plain - expected).max() > 0.01, "texts change the motion"

        steps = np.linalg.norm(np.diff(shown, axis=0), axis=-1).max(1)
        seams = np.isin(np.arange(1, len(shown)), [request["from"] for request in requests])
        assert steps[seams].max() < 1.5 * steps[~seams].max()

        tab.click("#live .bvh")
        while not (tmp_path / "stream.bvh").exists():  # until the time of the test is up
            tab.run("new Promise((done) => setTimeout(done, 50))")
        saved = read(tmp_path / "stream.bvh").joints
        assert np.abs(saved - shown[-len(saved) :]).max() < 0.05
        assert tab.errors == []


@of_page
def test_a_click_on_a_waypoint_removes_it(served: tuple[Path, str], tmp_path: Path) -> None:
    with browser(tmp_path / "profile") as tab:
        tab.open(f"{served[1]}live.html")
        tab.wait("document.body?.dataset.ready", 120)
        tab.run("live.pause(true)")
        click_floor(tab, 0.2, 0.8)
        click_floor(tab, 0.8, 0.8)
        tab.wait("live.points.length === 2")
        click_floor(tab, 0.2, 0.05)  # above the horizon
        places = tab.run("live.points.map(({ place }) => place)")
        click_floor(tab, 0.2, 0.8)
        tab.wait("live.points.length === 1")
        assert tab.run("live.points[0].place") == places[1]
        tab.click("#live .clear")
        assert tab.run("live.points.length") == 0
        tab.run("for (let k = 0; k < 17; k++) live.addPoint([k, 1])")
        assert tab.run("live.points.length") == 16
        assert "at most 16" in tab.run("document.querySelector('#live p').textContent")
        assert tab.errors == []
