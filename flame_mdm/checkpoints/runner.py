"""Samples motions from a model that was exported to ONNX. Requires only numpy and onnxruntime.

`flame-mdm export CKPT FOLDER format=onnx` writes the folder of the model.

python runner.py FOLDER "a person walks forward" motion.npz seconds=3 seed=0

For the same caption, length and seed, `flame_mdm.generate` returns an identical motion. It also
understands sentences that differ from the captions of the training data. A model that continues
frames starts from a standing person.
"""

from __future__ import annotations

import hashlib
import json
import math
import re
import secrets
import sys
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

FORMAT = 1
MIN_WORDS = 3  # minimum number of tokens in the input of a graph, including padding
WORD = re.compile(r"[^\W_]+")
NUMBERS = frozenset(
    [
        "zero",
        "one",
        "two",
        "three",
        "four",
        "five",
        "six",
        "seven",
        "eight",
        "nine",
        "ten",
        "eleven",
        "twelve",
    ]
)
MASK = (1 << 64) - 1
# Maximum duration in seconds for a model that continues frames
LONGEST = 600
# Length of a motion in seconds by default, if the model's maximum is not lower
USUAL_SECONDS = 3.0
# The last graph exists only for SMPL's joints.
GRAPHS = ("denoiser.onnx", "joints.onnx", "poses.onnx")
# Maximum size of model.json in bytes
MAX_DESCRIPTION = 64 * 2**20
# Maximum size of an ONNX file in bytes, which is the limit of the format
MAX_GRAPH = 2**31
EXTERNAL_DATA = re.compile(rb"(?:\x08|\x88\x80*\x00)location")
"""Pattern of the key that names a file of external data, after its length.

protobuf may write the length with more bytes than necessary.
"""


def _object(required: Sequence[str], **properties: dict[str, Any]) -> dict[str, Any]:
    return {"type": "object", "properties": properties, "required": list(required)}


def _array(items: dict[str, Any], most: int, least: int = 0) -> dict[str, Any]:
    return {"type": "array", "items": items, "minItems": least, "maxItems": most}


def _number(least: float, most: float, kind: str = "integer") -> dict[str, Any]:
    return {"type": kind, "minimum": least, "maximum": most}


TEXTS = _array({"type": "string"}, 1_000_000)
PRINTABLE = {"type": "string", "pattern": r"[^\x00-\x1f\x7f-\x9f]{1,1000}"}
HASH = {"type": "string", "pattern": "[0-9a-f]{64}"}
# fmt: off
REQUIRED = (
    "format", "reads", "actions", "vocabulary", "captions", "function_words", "features", "fps", "max_frames",
    "padded_frames", "skeleton", "clip_x0", "steps", "sha256", "digest",
)
# fmt: on
SCHEMA = _object(
    REQUIRED,
    format=_number(FORMAT, FORMAT),
    experiment=PRINTABLE,
    reads={"type": "string", "pattern": "none|action|text"},
    buckets=_number(1, 10_000_000),
    max_words=_number(1, 1000),
    actions=_array(PRINTABLE, 100_000),
    vocabulary=TEXTS,
    captions=TEXTS,
    function_words=TEXTS,
    features=_number(1, 2000),
    fps=_number(1, 1000, "number"),
    max_frames=_number(2, 10_000),
    padded_frames=_number(0, 10_000),
    start=_array(_array(_number(-1e9, 1e9, "number"), 2000, 1), 9_999, 1),
    fade=_object(
        ("frames", "begin", "end"),
        frames=_number(1, 9_999),
        begin=_number(0, 2000),
        end=_number(0, 2000),
    ),
    root=_array(_array(_number(-1e9, 1e9, "number"), 2, 2), 3, 3),
    skeleton=_object(
        ["joints", "parents", "feet"],
        joints=_array({"type": "string"}, 1000, 1),
        parents=_array(_number(-1, 999), 1000, 1),
        feet={"type": "array", "maxItems": 1000},
    ),
    clip_x0={"type": "boolean"},
    steps=_array(_array(_number(-1e9, 1e9, "number"), 7, 7), 10_000, 1),
    sha256=_object(GRAPHS[:2], **dict.fromkeys(GRAPHS, HASH)),
    digest=HASH,
)
"""JSON schema of `model.json`, in the subset of JSON Schema that `faults` reads.

The web page has the same schema.
"""
TYPES: dict[str, type | tuple[type, ...]] = {
    "object": dict,
    "array": list,
    "string": str,
    "boolean": bool,
    "integer": int,
    "number": (int, float),
}


def faults(value: Any, schema: Mapping[str, Any], name: str = "") -> list[str]:
    """Returns the dotted names of the values that a JSON schema rejects.

    If an item of a list is rejected, the name of the list is returned. The schema contains types,
    bounds for numbers and for list lengths, patterns for entire strings, and required keys.
    Objects may contain keys that are not in the schema.
    """
    kind = schema["type"]
    if not _has_type(value, kind):
        return [name]

    if kind in ("integer", "number"):
        return [] if schema["minimum"] <= value <= schema["maximum"] else [name]

    if kind == "string":
        return [] if re.fullmatch(schema.get("pattern", r"(?s:.*)"), value) else [name]

    if kind == "array":
        if not schema.get("minItems", 0) <= len(value) <= schema["maxItems"]:
            return [name]
        items = schema.get("items")
        return [name] if items and any(faults(item, items) for item in value) else []

    wrong = []
    for key, part in schema.get("properties", {}).items():
        full = f"{name}.{key}".lstrip(".")
        if key in value:
            wrong += faults(value[key], part, full)
        elif key in schema["required"]:
            wrong.append(full)
    return wrong


def _has_type(value: Any, kind: str) -> bool:
    if isinstance(value, bool):  # Python's bool is an int
        return kind == "boolean"
    return isinstance(value, TYPES[kind])


def check(content: Any) -> None:
    """Raises `ValueError` if `model.json` is damaged, has been changed, or violates `SCHEMA`."""
    if not isinstance(content, dict):
        raise ValueError("model.json is damaged")
    if content.get("format") != FORMAT:
        raise ValueError(f"model.json does not have format {FORMAT}")
    if content.get("digest") != digest(content):
        raise ValueError("model.json has changed since it was exported")

    wrong = faults(content, SCHEMA)
    if not wrong and content["reads"] == "text":
        wrong += [name for name in ("buckets", "max_words") if name not in content]
    if not wrong and content["padded_frames"] not in (0, content["max_frames"]):
        wrong.append("padded_frames")
    start = content.get("start", [])
    if not wrong and (
        len(start) > content["max_frames"] - 2
        or any(len(row) != content["features"] for row in start)
    ):
        wrong.append("start")
    if wrong:
        raise ValueError(f"model.json is damaged: {', '.join(wrong)}")


def read_file(path: Path, most: int) -> bytes:
    """Returns the contents of a regular file of at most `most` bytes.

    Raises `ValueError` for any other file, and `OSError` if the file cannot be read.
    """
    if path.exists() and not path.is_file():
        raise ValueError(f"{path.name} is a folder, a pipe or a device")
    with path.open("rb") as file:
        content = file.read(most + 1)
    if len(content) > most:
        raise ValueError(f"{path.name} has more than {most} bytes")
    return content


def first_line(error: Exception) -> str:
    """Returns the first line of an error's message, or the error's type if it has no message."""
    lines = str(error).strip().splitlines()
    return lines[0] if lines else type(error).__name__


class Sampler:
    """An exported model in a folder: the `content` of `model.json`, and onnxruntime sessions.

    `poses` is None unless the model generates SMPL's joints.
    """

    def __init__(self, folder: str | Path, threads: int = 1):
        """Opens a folder.

        Raises `ValueError` if a file is missing, damaged, too large or from a different version.
        """
        self.folder = Path(folder)
        try:
            self.content = self._description()
            sessions = {
                name: self._session(name, threads)
                for name in GRAPHS
                if name in self.content["sha256"]
            }
        except (OSError, ValueError) as error:
            reason = first_line(error)
            raise ValueError(
                f"{self.folder}: not an exported model ({reason}). Export the model again"
            ) from error
        self.denoiser, self.joints = sessions["denoiser.onnx"], sessions["joints.onnx"]
        self.poses = sessions.get("poses.onnx")

    def _description(self) -> dict[str, Any]:
        text = read_file(self.folder / "model.json", MAX_DESCRIPTION)
        try:
            content = json.loads(text.decode("utf-8"))
        except (ValueError, RecursionError) as error:
            raise ValueError("model.json is damaged: not JSON") from error
        check(content)
        return content

    def _session(self, name: str, threads: int) -> Any:
        """Opens a graph and returns its session.

        The weights must be in the same file: a graph must not refer to other files.
        """
        import onnxruntime

        graph = read_file(self.folder / name, MAX_GRAPH)
        if hashlib.sha256(graph).hexdigest() != self.content["sha256"][name]:
            raise ValueError(f"{name} has changed since it was exported")
        if EXTERNAL_DATA.search(graph):
            raise ValueError(f"{name} reads data from other files")

        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = threads
        options.log_severity_level = 4  # errors are raised
        options.add_session_config_entry("session.load_model_format", "ONNX")
        try:
            return onnxruntime.InferenceSession(graph, options, providers=["CPUExecutionProvider"])
        except Exception as error:  # onnxruntime raises its own kinds of errors
            raise ValueError(f"{name} is damaged: {first_line(error)}") from error

    def unknown(self, text: str) -> list[str]:
        """Returns the content words in a text that are unknown to the model.

        Raises `ValueError` if the model knows none of the content words.
        """
        seen, skipped = set(self.content["vocabulary"]), set(self.content["function_words"])
        content = [word for word in dict.fromkeys(words(text)) if seen and word not in skipped]
        unknown = [word for word in content if not known_form(word, seen)]
        if seen and unknown == content:
            raise ValueError(f"'{text}': the model knows no word for an action in this text")
        return unknown

    def generate(
        self,
        prompt: str = "",
        seconds: float | None = None,
        seed: int = 0,
        sample: int = 0,
        text: str | None = None,
    ) -> np.ndarray:
        """Returns the normalized features (F, D) of one motion, for a text or an action.

        For an unconditional model, the prompt is "". `sample` is the sample index, which
        distinguishes several motions for the same prompt. The default of `seconds` is 3 or the
        model's maximum, whichever is lower. For a model that continues frames, the maximum is 600
        seconds. Raises `ValueError` for an invalid length or an unknown action, or if the result
        contains NaN or infinity.

        `flame_mdm.generate` draws noise for the sentence exactly as the user typed it. If this
        sentence differs from the caption `prompt`, pass it as `text` to obtain the same noise.
        """
        content = self.content
        fps = content["fps"]
        longest = round(LONGEST * fps) if "start" in content else content["max_frames"]
        if seconds is None:
            frames = min(round(USUAL_SECONDS * fps), longest)
        else:
            frames = round(min(seconds * fps, longest + 1)) if seconds > 0 else 0
        if not 2 <= frames <= longest:
            raise ValueError(f"seconds={seconds}: give {2 / fps:g} to {longest / fps:g} seconds")

        condition = self._condition(prompt)
        name = f"{prompt if text is None else text}#{sample}"
        if "start" not in content:
            padded = max(frames, content["padded_frames"])
            inputs = condition | {"lengths": np.array([frames])}
            x = self._sample(inputs, padded, key("noise", seed, 0, name))[:frames]
        else:
            x = np.array(content["start"], np.float32)
            context, block = len(x), content["max_frames"] - len(x)
            inputs = condition | {"lengths": np.array([block])}
            for number in range(math.ceil(frames / block)):
                prefix = {"prefix": x[None, -context:]}
                noise = key("noise", seed, 0, f"{name}\x1f{number}")
                after = self._sample(inputs | prefix, block, noise)
                x = np.concatenate([x, joined(x[-2:], after, content.get("fade"))])
            x = x[context : context + frames]
        if not np.isfinite(x).all():
            raise ValueError(
                f"the model returned non-finite numbers for '{prompt}'. Export it again"
            )
        return x

    def _sample(self, inputs: dict[str, np.ndarray], frames: int, number: int) -> np.ndarray:
        """Samples `frames` frames together and returns their normalized features (F, D).

        `number` seeds the noise.
        """
        content = self.content
        x, draw = normal(number, frames, content["features"]), 1
        before = np.zeros_like(x)
        for t, of_x, of_output, keep, clean, last, noise in content["steps"]:
            values = {"x_t": x[None], "t": np.array([t], np.float32), **inputs}
            output = self._run("denoiser", values, [(1, *x.shape)])[0][0]
            x0_hat = np.float32(of_x) * x + np.float32(of_output) * output
            if content["clip_x0"]:
                x0_hat = x0_hat.clip(-1, 1)
            x = np.float32(keep) * x + np.float32(clean) * x0_hat + np.float32(last) * before
            if noise:
                x, draw = (
                    x + np.float32(noise) * normal(number + draw, frames, content["features"]),
                    draw + 1,
                )
            before = x0_hat
        return x

    def decode(self, x: np.ndarray) -> np.ndarray:
        """Converts normalized features (F, D) to joint positions (F, J, 3) in meters, with y up."""
        shape = (1, len(x), len(self.content["skeleton"]["joints"]), 3)
        return self._run("joints", {"x": x[None]}, [shape])[0][0]

    def rotations(self, joints: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns the rest-pose offsets and local rotations, which exist only for SMPL's 22 joints.

        The offsets (22, 3) are the positions of the joints relative to their parents in the rest
        pose, in which the arms are stretched out to the sides. Quaternions (F, 22, 4) are in (w, x,
        y, z) order; the quaternion of the root is in world coordinates.
        """
        if self.poses is None:
            raise ValueError("rotations are computed only for SMPL's 22 joints")
        offsets, quaternions = self._run(
            "poses", {"joints": joints}, [(22, 3), (len(joints), 22, 4)]
        )
        return offsets, quaternions

    def _run(
        self, name: str, inputs: dict[str, np.ndarray], shapes: Sequence[tuple[int, ...]]
    ) -> list[np.ndarray]:
        """Returns the outputs of a graph.

        Raises `ValueError` if the graph cannot run, or if its outputs have unexpected shapes.
        """
        session = getattr(self, name)
        try:
            outputs = session.run(None, inputs)
        except Exception as error:  # onnxruntime raises its own kinds of errors
            raise ValueError(
                f"{name}.onnx cannot run: {first_line(error)}. Export the model again"
            ) from error
        if [np.shape(output) for output in outputs] != list(shapes):
            raise ValueError(f"{name}.onnx does not match model.json. Export the model again")
        return outputs

    def _condition(self, prompt: str) -> dict[str, np.ndarray]:
        content = self.content
        if content["reads"] == "none":
            return {}
        if content["reads"] == "action":
            if prompt not in content["actions"]:
                raise ValueError(
                    f"unknown action '{prompt}'; this model knows: {', '.join(content['actions'])}"
                )
            return {"condition": np.array([content["actions"].index(prompt)])}
        read = words(prompt)
        if seen := set(content["vocabulary"]):
            read = [form for word in read if (form := known_form(word, seen))]
        rows = [
            hashed(word, content["buckets"]) for word in ["<start>", *read[: content["max_words"]]]
        ]
        padding = [(0, 0)] * max(0, MIN_WORDS - len(rows))
        return {"condition": np.array([[*rows, *padding]]), "counts": np.array([len(rows)])}


def digest(content: dict[str, Any]) -> str:
    """Returns the hash of `model.json` without its key "digest"."""
    rest = {name: value for name, value in content.items() if name != "digest"}
    return hashlib.sha256(json.dumps(rest).encode()).hexdigest()


def words(text: str) -> list[str]:
    """See `flame_mdm.conditions.vocabulary.words`."""
    return WORD.findall(text.lower())


def known_form(word: str, seen: set[str]) -> str | None:
    """See `flame_mdm.conditions.vocabulary.known_form`."""
    if word in NUMBERS and word not in seen:
        return None
    stems = [
        word.removesuffix(suffix)
        for suffix in ("ing", "ed", "es", "s", "d", "")
        if word.endswith(suffix)
    ]
    stems += [stem[:-1] for stem in stems if len(stem) > 3 and stem[-1] in f"e{stem[-2]}"]
    forms = [
        stem + ending
        for stem in stems
        if len(stem) > 2
        for ending in ("", "e", "s", "es", "ing", "ed")
    ]
    return next((form for form in [word, *forms] if form in seen), None)


def hashed(word: str, buckets: int) -> tuple[int, int]:
    """See `flame_mdm.conditions.vocabulary.hashed`."""
    number = zlib.crc32(word.encode())
    return number % buckets, number // buckets % buckets


def key(*parts: str | int) -> int:
    """See `flame_mdm.seeds.key`."""
    text = "\x1f".join(str(part) for part in parts)
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:8], "big") >> 1


def mixed(counters: np.ndarray) -> np.ndarray:
    """Hashes uint64 counters (splitmix64)."""
    x = counters + np.uint64(0x9E3779B97F4A7C15)
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return x ^ (x >> np.uint64(31))


def joined(before: np.ndarray, x: np.ndarray, fade: Mapping[str, int] | None) -> np.ndarray:
    """See `flame_mdm.generator.joined`. `before` (2, D) contains the frames before x (F, D)."""
    if fade is None:
        return x
    share = np.arange(min(fade["frames"], len(x)), dtype=np.float32) / np.float32(fade["frames"])
    weight = (1 - share) ** 2 * (1 + 2 * share)
    jump = before[-1] + (before[-1] - before[0] + x[1] - x[0]) / 2 - x[0]
    moved = x.copy()
    pose = slice(fade["begin"], fade["end"])
    moved[: len(share), pose] += weight[:, None] * jump[pose]
    return moved


def normal(number: int, frames: int, features: int) -> np.ndarray:
    """Returns float32 standard normal noise (F, D) for a key; see `flame_mdm.seeds.normal`."""
    pairs = (features + 1) // 2
    first = mixed(mixed(np.array([number & MASK], np.uint64)))
    positions = np.arange(frames * pairs, dtype=np.uint64) * np.uint64(0x9E3779B97F4A7C15)
    bits = mixed(first + positions)
    low, high = (
        (part & np.uint64(0xFFFFFF)).astype(np.float32) for part in (bits, bits >> np.uint64(40))
    )
    half, scale = np.float32(0.5), np.float32(2.0**-24)
    radius = np.sqrt(-2 * np.log((low + half) * scale))
    angle = np.float32(2 * np.pi) * ((high + half) * scale)
    both = np.stack([radius * np.cos(angle), radius * np.sin(angle)], -1)
    return both.reshape(frames, 2 * pairs)[:, :features]


def write(path: str | Path, **arrays: Any) -> Path:
    """Writes an .npz file under a temporary name, and renames it at the end.

    Returns the path of the file, whose name ends with .npz. A failure leaves no files behind. If
    `path` is a link, the link is replaced, and its target does not change. Raises `ValueError` if
    `path` is a folder, a pipe or a device, and `OSError` if the file cannot be written.
    """
    path = Path(path)
    if path.suffix != ".npz":
        path = path.with_name(f"{path.name}.npz")
    if path.exists() and not path.is_file():
        raise ValueError(f"{path}: a folder, a pipe or a device, not a file. Choose another name")
    if not path.parent.is_dir():
        raise ValueError(f"{path}: its folder does not exist. Create it")

    temporary = path.with_name(f".{path.stem[:80]}.{secrets.token_hex(8)}.npz")
    try:
        with temporary.open("xb") as file:
            np.savez_compressed(file, allow_pickle=False, **arrays)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)
    return path


def _number_of(options: Mapping[str, str], key: str, kind: type[Any]) -> Any:
    if key not in options:
        return None
    try:
        return kind(options[key])
    except ValueError as error:
        raise ValueError(
            f"{key}={options[key][:40]}: give a {'whole ' if kind is int else ''}number"
        ) from error


def main(arguments: Sequence[str]) -> int:
    """Writes one motion as .npz: its joint positions `joints` (F, J, 3) in meters, and `fps`."""
    positional = [word for word in arguments if not re.match(r"(seconds|seed)=", word)]
    options = dict(word.split("=", 1) for word in arguments if word not in positional)
    if len(positional) != 3:
        print(
            'usage: python runner.py FOLDER "TEXT OR ACTION" motion.npz [seconds=3] [seed=0]',
            file=sys.stderr,
        )
        return 2
    folder, prompt, out = positional
    try:
        seconds = _number_of(options, "seconds", float)
        seed = _number_of(options, "seed", int)
        sampler = Sampler(folder)
        if unknown := sampler.unknown(prompt):
            print(f"warning: never seen in training: {', '.join(unknown)}")
        joints = sampler.decode(sampler.generate(prompt, seconds, seed or 0))
        path = write(out, joints=joints, fps=sampler.content["fps"], text=prompt)
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    print(
        f"{path}: {len(joints)} frames at {sampler.content['fps']:g} frames per second, joints in meters, y up"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
