"""Generates the motions for the page.

The model handles one request at a time, and the latest results stay in memory.
"""

import tempfile
import time
from collections import OrderedDict
from collections.abc import Callable, Sequence
from pathlib import Path
from threading import Event, Lock, get_ident
from typing import Any

from flame_mdm.checkpoints.loading import find, load
from flame_mdm.conditions.language.reading import Reader, Reading
from flame_mdm.conditions.vocabulary import advice
from flame_mdm.demo.live import LiveStreams
from flame_mdm.demo.request import MAX_SECONDS, PLUS, DemoRequest, checked
from flame_mdm.errors import UserError, did_you_mean, one_line
from flame_mdm.formats.cleanup import cleaned
from flame_mdm.formats.motion import Motion
from flame_mdm.generator import MotionGenerator
from flame_mdm.sampling.editing import edit
from flame_mdm.sampling.generation import generate
from flame_mdm.sampling.motion_request import SamplingRequest, read_parts
from flame_mdm.sampling.resolution import resolve

# Number of requests whose motions stay in memory, so that downloads and edits do not require them
# to be sampled again
KEPT = 64
# Maximum time in seconds for which a request may occupy the model
TIME_LIMIT = 300.0
# Names of the download formats on the page, by extension
FORMATS = {
    ".bvh": "BVH",
    ".fbx": "FBX",
    ".glb": "GLB",
    ".npz": "NPZ",
    ".mp4": "MP4",
}


class Studio:
    """Generates motions for requests, using only the models in `sources`.

    A source is an argument of `load`, or "MODEL + ADAPTER".
    """

    def __init__(self, sources: Sequence[str], device: str):
        self.device = device
        self.files = {name: find(name.partition(PLUS)[0]) for name in sources}
        self._models: dict[str, MotionGenerator] = {}
        self._readers: dict[str, Reader] = {}
        self._made: OrderedDict[tuple[Any, ...], Sequence[Motion]] = OrderedDict()
        self._working, self._memory = Lock(), Lock()
        models = [self.model(name) for name in sources if PLUS not in name]
        streaming = [model for model in models if model.denoiser.context_frames]
        self.live = LiveStreams(streaming[0]) if streaming else None

    def model(self, name: str) -> MotionGenerator:
        """Returns the model with this name on the page. Raises `UserError` if the name is unknown.

        A model with an adapter is loaded only when it is first used.
        """
        if name not in self.files:
            near = did_you_mean(name, self.files)
            raise UserError(
                f"unknown model {name[:60]!r}.{near} Available: {', '.join(self.files)}"
            )
        if name not in self._models:
            adapter = name.partition(PLUS)[2]
            model = load(self.files[name], self.device, adapter=[adapter] if adapter else ())
            if model.conditioned_on == "text" and Reader.fits(model.facts):
                reader = self._readers[name] = Reader(model.facts)
                # Read the language tables in advance, so that the first response does not wait for
                # them.
                for action in reader.abilities.actions:
                    reader.abilities.choices(action)
            self._models[name] = model
        return self._models[name]

    def reader(self, name: str) -> Reader | None:
        """Returns a model's text reader.

        Returns None if the model's captions do not describe single actions.
        """
        self.model(name)
        return self._readers.get(name)

    def motions(
        self,
        request: DemoRequest,
        report: Callable[[int], None] = lambda calls: None,
        stop: Event | None = None,
    ) -> Sequence[Motion]:
        """Returns the motions for a request, from memory if possible.

        `report` is called with the number of times that the neural network has been called so far.
        """
        with self._working:
            model = self.model(request.model)
            steps, cleanup = _plan(model, request)
            calls, deadline, thread = 0, time.monotonic() + TIME_LIMIT, get_ident()

            def before(*_: object) -> None:
                nonlocal calls
                # The call may belong to another visitor's stream, which uses the model at the same
                # time
                if get_ident() != thread:
                    return
                if stop is not None and stop.is_set():
                    raise UserError("canceled")
                if time.monotonic() > deadline:
                    raise UserError(
                        f"stopped after {TIME_LIMIT:g} seconds. Use fewer steps or samples, or a shorter duration"
                    )
                report(calls)
                calls += 1

            hook = model.denoiser.register_forward_pre_hook(before)
            try:
                motions: Sequence[Motion] = ()
                for number, (source, arguments) in enumerate(steps):
                    key = (request.model, repr(steps[: number + 1]))
                    if key in self._made:
                        motions = self._made[key]
                    elif source is None:
                        motions = generate(model, **arguments)
                    else:
                        motions = edit(model, _numbered(motions, source), **arguments)
                    with self._memory:
                        self._made[key] = motions
                        self._made.move_to_end(key)
                        while len(self._made) > KEPT:
                            self._made.popitem(last=False)
            finally:
                hook.remove()
        return _cleaned(model, motions) if cleanup else motions

    def understood(self, request: DemoRequest) -> DemoRequest:
        """Returns the request, with a sentence of several actions converted to a sequence.

        Raises the same errors as `generate`.
        """
        if not request.text or (model := self.model(request.model)).conditioned_on != "text":
            return request
        check_length(request)
        sentence = SamplingRequest(texts=request.text, split=request.split, seconds=request.seconds)
        text = resolve(sentence, model).prompts[0].text
        return checked(request.model_dump() | {"text": text})

    def readings(self, request: DemoRequest) -> list[Reading]:
        """Returns the meaning of each part of the text, or [] if the model has no text reader."""
        reader = self.reader(request.model)
        if reader is None or not request.text or not request.split:
            return []
        return [reader.read(words) for words, _ in read_parts(request.text)]

    def advice(self, request: DemoRequest) -> list[str]:
        """Returns messages about words that the model never saw in training or does not read."""
        model = self.model(request.model)
        if model.conditioned_on != "text" or self.readings(request):
            return []
        texts = [part.text for part in (request, *request.edits) if part.text]
        parts = dict.fromkeys(words for text in texts for words, _ in read_parts(text))
        return [
            line
            for words in parts
            for line in advice(words, model.facts, model.condition.max_words)
        ]

    def file(
        self, request: DemoRequest, number: int, extension: str, rig: str | None = None
    ) -> bytes:
        """Returns the contents of a motion file with the motion at index `number`.

        The motion must be in memory, so that downloads do not wait for requests.
        """
        if extension not in FORMATS:
            raise UserError(
                f"{one_line(extension[:20])}: this format is not available. Use "
                f"one of {', '.join(FORMATS)}"
            )
        motions = None
        if model := self._models.get(request.model):
            steps, cleanup = _plan(model, request)
            with self._memory:
                motions = self._made.get((request.model, repr(steps)))
        if model is None or motions is None:
            raise UserError(
                "this motion is no longer in memory. Open the link to the motion, and download the file there"
            )
        motion = _numbered(_cleaned(model, motions) if cleanup else motions, number)
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder, f"motion{extension}")
            try:
                motion.save(path, rig=rig)
            except UserError as error:  # visitors must not see where files are written
                raise UserError(str(error).replace(str(path), path.name)) from error
            return path.read_bytes()


def _numbered(motions: Sequence[Motion], number: int) -> Motion:
    if number >= len(motions):
        raise UserError(f"motion={number}: there are {len(motions)} motions, numbered from 0")
    return motions[number]


def _plan(
    model: MotionGenerator, request: DemoRequest
) -> tuple[list[tuple[int | None, dict[str, Any]]], bool]:
    if model.conditioned_on != "none" and not request.text:
        raise UserError("the text is empty. Describe what the person does")
    check_length(request)
    steps = request.steps(model.conditioned_on)
    return steps, bool(steps[-1][1].pop("cleanup", False))


def check_length(request: DemoRequest) -> None:
    """Raises `UserError` if the parts of the text are longer than the page allows."""
    parts = read_parts(request.text) if request.text else []
    if request.total_seconds(parts) > MAX_SECONDS:
        raise UserError(f"the parts are too long. Use at most {MAX_SECONDS} seconds in total")


def _cleaned(model: MotionGenerator, motions: Sequence[Motion]) -> list[Motion]:
    contacts = model.representation.contacts
    return [cleaned(motion, contacts(motion.features)) for motion in motions]
