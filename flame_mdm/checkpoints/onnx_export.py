"""Exports models to ONNX graphs for onnxruntime.

The sampling loop, the skeleton and the vocabulary are written as JSON.
"""

import json
import logging
import shutil
import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from flame_mdm.batch import Condition, Edit, MotionBatch, length_mask
from flame_mdm.checkpoints.loading import load
from flame_mdm.checkpoints.runner import FORMAT, MIN_WORDS, SCHEMA, digest, faults
from flame_mdm.conditions.tokens import LearnedTokens
from flame_mdm.conditions.vocabulary import FUNCTION_WORDS
from flame_mdm.data.standing import standing
from flame_mdm.denoisers.gru import MDMGRU
from flame_mdm.denoisers.unet import MDMUNet
from flame_mdm.errors import UserError, first_line
from flame_mdm.formats.poses import solve_checked
from flame_mdm.generator import FADE, MotionGenerator
from flame_mdm.processes import Process
from flame_mdm.processes.guidance import classifier_free_guidance
from flame_mdm.progress import ProgressBar
from flame_mdm.representations.humanml import HumanML
from flame_mdm.representations.skeleton import SMPL22
from flame_mdm.safe_io import atomic_folder, sha256, write_json
from flame_mdm.sampler_options import SamplerOptions

RUNNER = Path(__file__).with_name("runner.py")
# Maximum difference between the outputs of a graph and of PyTorch, relative to the largest output.
# In float32, a different order of operations changes results by about 1e-6.
TOLERANCE = 1e-4
# The ONNX graphs of these networks require a fixed number of frames, so motions are padded to the
# longest length.
FIXED_LENGTH = (
    MDMGRU,
    MDMUNet,
)
TINY = 1e-6  # an input of `to_x0` that is so small that the clean estimate is not clipped


def export_onnx(source: str | Path, out: str | Path, *, half: bool = False, **adapted: Any) -> Path:
    """Writes a model as a folder of ONNX graphs that need only numpy and onnxruntime.

    The folder contains `runner.py`, which samples motions with the graphs. docs/export.md describes the
    files.

    Args:
        source: the model, as in `flame_mdm.load`.
        out: the folder.
        half: whether to store weight matrices in half precision.
        adapted: adapters to merge into the weights, and their strengths, as in `flame_mdm.load`.

    Raises:
        UserError: For the same reasons as in `flame_mdm.load`, if a part cannot be exported, or if
            the outputs of a graph differ from PyTorch's.
    """
    try:
        import onnxruntime  # noqa: F401
        import onnxscript  # noqa: F401
    except ImportError as error:
        raise UserError(
            f'format=onnx requires the {error.name} package. Run pip install "flame-mdm[onnx]"'
        ) from error
    write_folder(load(source, **adapted), out, half=half)
    return Path(out)


def write_folder(model: MotionGenerator, out: str | Path, *, half: bool = False) -> None:
    """Writes a loaded model as the folder that `export_onnx` describes."""
    content = description(model)
    with atomic_folder(out) as folder, torch.no_grad(), torch.random.fork_rng():
        torch.manual_seed(0)  # the comparison with PyTorch uses random inputs
        for graph in ProgressBar(graphs(model), desc="graphs", unit="graph"):
            path = folder / f"{graph.name}.onnx"
            write_graph(graph, path, half and graph.name == "denoiser")
            content["sha256"][path.name] = sha256(path)
        write_json(folder / "model.json", content | {"digest": digest(content)}, indent=None)
        shutil.copy(RUNNER, folder / RUNNER.name)


def description(model: MotionGenerator) -> dict[str, Any]:
    """Returns the contents of `model.json`, without the hashes of the graphs.

    Raises:
        UserError: If a value is outside the limits of the runner, or if the sampler cannot be
            exported.
    """
    representation = model.representation
    skeleton = model.representation.skeleton
    facts = model.facts
    encoder, denoiser = model.condition, model.denoiser
    padded = isinstance(denoiser, FIXED_LENGTH) or not denoiser.mask_padding
    words = (
        {"buckets": encoder.buckets, "max_words": encoder.max_words}
        if isinstance(encoder, LearnedTokens)
        else {}
    )
    context = {}
    if denoiser.context_frames:
        start = torch.from_numpy(standing(representation, denoiser.context_frames).features)
        context["start"] = representation.normalize(start.to(model.device)).tolist()
        pose = representation.pose
        context["fade"] = {
            "frames": round(FADE * representation.fps),
            "begin": pose.start,
            "end": pose.stop,
        }
        if isinstance(representation, HumanML):
            context["root"] = root_units(representation)
    content = {
        "format": FORMAT,
        "experiment": model.config["experiment"],
        "reads": model.conditioned_on,
        **words,
        **context,
        "actions": list(facts.get("actions", ())),
        "vocabulary": list(facts.get("vocabulary", ())),
        "captions": list(facts.get("captions", ())),
        "function_words": sorted(FUNCTION_WORDS),
        "features": representation.features,
        "fps": representation.fps,
        "max_frames": facts["max_frames"],
        "padded_frames": facts["max_frames"] if padded else 0,
        "skeleton": {"joints": skeleton.joints, "parents": skeleton.parents, "feet": skeleton.feet},
        "clip_x0": bool(getattr(model.process, "clip_x0", False)),
        "steps": sampling_plan(model.process, model.sampler_options),
    }
    wrong = [
        name
        for name in faults(json.loads(json.dumps(content)), SCHEMA)
        if name not in ("sha256", "digest")
    ]
    if wrong:
        raise UserError(f"{wrong[0]}: outside the limits for exported models (see docs/export.md)")
    return content | {"sha256": {}}


def root_units(representation: HumanML) -> list[list[float]]:
    """Returns the mean and standard deviation of each of the first three features.

    These features are the root's turn in radians, and its movements to the left and forward in
    meters.
    """
    scale = representation.mean.new_ones(3)
    scale[0] = representation.turn_unit
    scale[1:] /= representation.units_per_metre
    return torch.stack(
        [representation.mean[:3] * scale, representation.std[:3] * scale], 1
    ).tolist()


class Probe:
    """Records how a sampler combines noise and clean estimates.

    The probe takes the place of the denoiser, the noise and the `Guide`. `variance` is the constant
    that the probe returns in the channels of a learned variance.
    """

    # All exported samplers are linear: each noisy motion is a weighted sum of noise draws and clean
    # estimates. The sampler is therefore run once on unit vectors instead of motions.
    # Draw n is unit vector n, and clean estimate k is unit vector `calls` + 1 + k.
    # The entries of a noisy motion (1, 1, 2 `calls` + 1) in this run are then its weights, from
    # which `_plan` computes the four numbers of each step. No sampler needs its own formula here.
    def __init__(self, process: Process, calls: int, variance: float):
        self.process, self.calls, self.variance, self.output = process, calls, variance, variance
        self.time, self.draws = 0.0, 0
        # For each call: x_t, the number of draws before the call, and (t, p, q).
        self.records: list[tuple[Tensor, int, list[float]]] = []

    def unit(self, number: int) -> Tensor:
        """Returns the unit vector that represents a noise draw or a clean estimate.

        The vector has shape (1, 1, 2 * calls + 1).
        """
        return functional.one_hot(torch.tensor(number), 2 * self.calls + 1).double()[None, None]

    def noise(self, draw: int) -> Tensor:
        """Counts the draw, and returns its unit vector instead of noise."""
        self.draws = draw + 1
        return self.unit(draw)

    def denoise(self, x_t: Tensor, t: Tensor, mask: Tensor, cond: Condition) -> Tensor:
        """Records the time of the call, and returns a constant instead of the denoiser's output."""
        self.time = float(t[0])
        return x_t.new_full((1, 1, self.process.out_features(x_t.shape[-1])), self.output)

    def steer(self, clean: Callable[[Tensor], Tensor], x_t: Tensor) -> Tensor:
        """Records the coefficients p and q of a call, computed from two tiny inputs."""
        if len(self.records) == self.calls:
            raise UserError("it chooses its own step sizes")
        # The clean estimate is p x + q y. An output y = 0 reveals p; an input x = 0 reveals q.
        row = []
        for self.output, x in ((0.0, x_t * 0 + TINY), (TINY, x_t * 0)):
            row.append(float(clean(x)[0, 0, 0]) / TINY)
        self.output = self.variance
        self.records.append((x_t, self.draws, [self.time, *row]))
        return x_t

    def reach(self, x0_hat: Tensor) -> Tensor:
        """Returns the unit vector of the clean estimate instead of the estimate itself."""
        return self.unit(self.calls + len(self.records))


def sampling_plan(process: Process, options: SamplerOptions) -> list[list[float]]:
    """Returns the sampling loop as rows of 7 numbers (t, p, q, a, b, c, d), one per denoiser call.

    The denoiser is called at time t and returns y. The clean estimate is `x0 = p x + q y`. The next
    noisy motion is `a x + b x0 + c x0' + d noise`, where `x0'` is the clean estimate of the
    previous call. Raises `UserError` for samplers whose loop does not have this form.
    """
    plans = [np.array(_plan(process, options, variance)) for variance in (0.0, 1.0)]
    if not np.array_equal(plans[0], plans[1]):
        raise UserError(
            f"sampler={options.sampler} draws noise with the variance that this model has learned, but exported graphs "
            "do not contain this variance. Set task.sampler to ddim or dpm_solver_pp_2m"
        )
    return plans[0].tolist()


def _plan(process: Process, options: SamplerOptions, variance: float) -> list[list[float]]:
    steps = options.num_inference_steps
    probe = Probe(process, 4 * (steps if isinstance(steps, int) else len(steps or ())), variance)
    like, mask = probe.unit(0), torch.ones(1, 1, dtype=torch.bool)
    edit = Edit(like * 0, torch.zeros_like(like, dtype=torch.bool), guide=probe)
    try:
        end = process.sample(
            probe.denoise, probe.noise, mask, Condition(like[0], like, mask), options, edit=edit
        )
    except UserError as error:
        raise UserError(f"sampler={options.sampler} cannot be exported: {error}") from error
    rows = []
    for number, (x_t, draws, row) in enumerate(probe.records):
        after, drawn, _ = (*probe.records, (end, probe.draws, []))[number + 1]
        # Each step must be a combination of four vectors: noisy motion, clean estimate, previous
        # clean estimate, and fresh noise. If a step does not use a vector, its column is zero.
        nothing = torch.zeros_like(x_t)
        columns = [
            x_t,
            probe.unit(probe.calls + 1 + number),
            probe.unit(probe.calls + number) if number > 0 else nothing,
            probe.unit(draws) if drawn > draws else nothing,
        ]
        matrix = torch.cat(columns, 1)[0].T.numpy()
        solution = np.linalg.lstsq(matrix, after.numpy().ravel())[0]
        if np.abs(matrix @ solution - after.numpy().ravel()).max() > 1e-9 * float(
            after.abs().max()
        ):
            raise UserError(
                f"sampler={options.sampler} combines more than two clean estimates, so it cannot "
                "be exported"
            )
        rows.append([*row, *np.where(np.abs(solution) > 1e-12, solution, 0.0).tolist()])
    return rows


class Graph(NamedTuple):
    """A module to export.

    `examples` maps the names of the inputs to example inputs, and `dimensions` names their
    variable-length axes.
    """

    name: str
    module: nn.Module
    examples: dict[str, Tensor]
    dimensions: dict[str, dict[int, Any]]
    outputs: Sequence[str]


class Call(nn.Module):
    """A call to a model's denoiser, with guidance.

    The condition encoder is included, but a learned variance is not.

    Inputs are x_t (B, F, D), the time t (B,) as a row index into the denoiser's sinusoidal table,
    lengths (B,) int64, and the condition. The condition is either actions (B,) int64, or a pair of
    tensors: indices (B, S, 2) int64 of rows in the word table, and `counts` (B,), the number of
    tokens in each caption. `ContinuingCall` also reads the frames before the motion.
    """

    def __init__(self, model: MotionGenerator):
        super().__init__()
        self.condition, self.denoiser = model.condition, model.denoiser
        if model.conditioned_on == "text" and not isinstance(self.condition, LearnedTokens):
            raise UserError(
                f"{type(self.condition).__name__}: language models cannot be exported to ONNX. "
                "Export a model with condition=learned, action or none"
            )
        self.features = model.representation.features
        self.scale = model.sampler_options.guidance_scale if model.condition.features else None

    def forward(
        self,
        x_t: Tensor,
        t: Tensor,
        lengths: Tensor,
        condition: Tensor | None = None,
        counts: Tensor | None = None,
    ) -> Tensor:
        """Returns the guided output (B, F, features) of the denoiser.

        Args:
            x_t: (B, F, D), noisy motion.
            t: (B,), times, as row indices into the denoiser's sinusoidal table.
            lengths: (B,), number of frames of each motion.
            condition: (B, S) tokens of texts, (B,) action indices, or None for an unconditional
                model.
            counts: (B,), number of tokens of each text.
        """
        return self._output(x_t, t, lengths, condition, counts, None)

    def _output(
        self,
        x_t: Tensor,
        t: Tensor,
        lengths: Tensor,
        condition: Tensor | None,
        counts: Tensor | None,
        prefix: Tensor | None,
    ) -> Tensor:
        mask = length_mask(lengths, x_t.shape[1])
        if (
            isinstance(self.condition, LearnedTokens)
            and condition is not None
            and counts is not None
        ):
            cond = self.condition.encode(condition, counts)
        else:
            cond = self.condition(MotionBatch(x_t, mask, [], action=condition))
        cond = replace(cond, prefix=prefix)
        denoise = self.denoiser
        if self.scale is not None and cond.null is not None:
            denoise = classifier_free_guidance(denoise, self.scale, self.features)
        return denoise(x_t, t, mask, cond)[..., : self.features]


class ContinuingCall(Call):
    """A call to a denoiser that continues previous frames, which are an additional input."""

    def forward(
        self,
        x_t: Tensor,
        t: Tensor,
        lengths: Tensor,
        prefix: Tensor,
        condition: Tensor | None = None,
        counts: Tensor | None = None,
    ) -> Tensor:
        """Returns the guided output (B, F, features) of the denoiser.

        Args:
            x_t: see `Call.forward`, which also describes `t`, `lengths`, `condition` and
                `counts`.
            prefix: (B, C, D), normalized features of the frames before the motion.
        """
        return self._output(x_t, t, lengths, condition, counts, prefix)


class Function(nn.Module):
    """Wraps a function as a module, as PyTorch's exporter requires."""

    def __init__(self, function: Callable[..., Any]):
        super().__init__()
        self.forward = function


def graphs(model: MotionGenerator) -> list[Graph]:
    """Returns the graphs of a model: the guided denoiser, and the decoders to joints and rotations.

    The decoder to rotations exists only for SMPL's skeleton.
    """
    representation = model.representation
    encoder = model.condition
    longest = model.facts["max_frames"]
    batch = torch.export.Dim("batch", max=1024)
    frames = torch.export.Dim("frames", min=4, max=max(longest, 5))
    x = torch.randn(2, min(longest, 9), representation.features)
    context = model.denoiser.context_frames
    fixed = isinstance(model.denoiser, FIXED_LENGTH) or context > 0
    of_call = longest - context if fixed else x.shape[1]
    inputs = {
        "x_t": torch.randn(2, of_call, representation.features),
        "t": torch.tensor([7.0, 3.0]),
        "lengths": torch.tensor([min(of_call, x.shape[1]), 2]),
    }
    if context:
        inputs["prefix"] = torch.randn(2, context, representation.features)
    dimensions: dict[str, dict[int, Any]] = {name: {0: batch} for name in inputs}
    if not fixed:
        dimensions["x_t"][1] = frames
    if isinstance(encoder, LearnedTokens):
        most = encoder.positions.shape[0]
        most = min(most, getattr(model.denoiser, "max_tokens", 0) or most)
        inputs |= {
            "condition": torch.randint(encoder.buckets, (2, 5, 2)),
            "counts": torch.tensor([5, 3]),
        }
        words = torch.export.Dim("words", min=MIN_WORDS, max=most)
        dimensions |= {"condition": {0: batch, 1: words}, "counts": {0: batch}}
    elif encoder.features:
        inputs["condition"] = torch.tensor([0, len(model.facts["actions"]) - 1])
        dimensions["condition"] = {0: batch}
    to_joints = Function(representation.to_joints)
    call = ContinuingCall(model) if context else Call(model)
    graphs = [Graph("denoiser", call, inputs, dimensions, ["output"])]
    graphs += [Graph("joints", to_joints, {"x": x}, {"x": {0: batch, 1: frames}}, ["joints"])]
    if representation.skeleton.name == SMPL22.name:
        solver = Function(partial(solve_checked, fps=representation.fps))
        # Poses near the mean pose: in poses from random features, rounding can turn a bone far.
        mean = representation.to_joints(torch.zeros_like(x[0]))
        joints = {"joints": mean + 0.1 * torch.randn(mean.shape)}
        graphs.append(
            Graph("poses", solver, joints, {"joints": {0: frames}}, ["offsets", "quaternions"])
        )
    return graphs


def traced(graph: Graph) -> torch.export.ExportedProgram:
    """Traces a graph's module and returns its operations.

    The named axes of the inputs may have any size.
    """
    dimensions = [graph.dimensions.get(name) for name in graph.examples]
    return torch.export.export(
        graph.module.eval(),
        tuple(graph.examples.values()),
        dynamic_shapes=dimensions,
        strict=False,
    )


def write_graph(graph: Graph, path: Path, half: bool) -> None:
    """Writes a graph.

    Raises `UserError` if the graph's outputs for one or two motions differ from PyTorch's.
    """
    import onnxruntime

    examples = list(graph.examples.values())
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)
    raw = path.with_suffix(".raw")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            names = {"input_names": list(graph.examples), "output_names": graph.outputs}
            program = torch.onnx.export(
                traced(graph), dynamo=True, verbose=False, optimize=False, **names
            )
            assert program is not None
            program.save(raw)
        # onnxruntime optimizes a graph in a second; PyTorch's exporter takes a minute.
        options = onnxruntime.SessionOptions()
        options.log_severity_level = 3
        options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_ENABLE_BASIC
        options.optimized_model_filepath = str(path)
        onnxruntime.InferenceSession(raw, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # the exporter raises many kinds of errors
        raise UserError(
            f"the {graph.name} cannot be exported to ONNX: {first_line(error)}"
        ) from error
    raw.unlink()
    _shrink(path, half)
    session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    single = examples if graph.name == "poses" else [example[:1] for example in examples]
    for values in (examples, single):
        outputs = session.run(
            None, {name: value.numpy() for name, value in zip(graph.examples, values, strict=True)}
        )
        expected = graph.module(*values)
        for ours, theirs in zip(
            outputs, [expected] if isinstance(expected, Tensor) else expected, strict=True
        ):
            difference = float(
                (torch.from_numpy(ours) - theirs).abs().max() / theirs.abs().max().clamp(min=1)
            )
            if not difference <= (100 * TOLERANCE if half else TOLERANCE):
                raise UserError(
                    f"the outputs of the {graph.name} in onnxruntime and PyTorch differ by {difference:.2g}"
                )


def _shrink(path: Path, half: bool) -> None:
    """Removes the descriptions of the nodes from a graph.

    With `half`, also stores matrices in half precision and adds casts.
    """
    import onnx
    from onnx import numpy_helper

    model = onnx.load(path)
    for node in model.graph.node:
        node.ClearField("metadata_props")
        node.ClearField("doc_string")
    for tensor in model.graph.initializer:
        if half and tensor.data_type == onnx.TensorProto.FLOAT and len(tensor.dims) > 1:
            name, values = tensor.name, numpy_helper.to_array(tensor).astype(np.float16)
            tensor.CopyFrom(numpy_helper.from_array(values, f"{name}.half"))
            model.graph.node.insert(
                0, onnx.helper.make_node("Cast", [tensor.name], [name], to=onnx.TensorProto.FLOAT)
            )
    onnx.save(model, path)
