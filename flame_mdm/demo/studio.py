"""Motions for the page: one request at a time on the model, the latest results in memory."""

from __future__ import annotations

import tempfile
import time
from collections import OrderedDict
from collections.abc import Callable, Sequence
from pathlib import Path
from threading import Event, Lock
from typing import Any

from flame_mdm.checkpoints.loading import find, load
from flame_mdm.conditions.vocabulary import advice
from flame_mdm.demo.request import MAX_SECONDS, Request
from flame_mdm.errors import UserError, did_you_mean
from flame_mdm.formats.cleanup import cleaned
from flame_mdm.formats.motion import Motion
from flame_mdm.sampling.editing import edit
from flame_mdm.sampling.generation import generate
from flame_mdm.sampling.request import read_parts
from flame_mdm.task import MotionGeneration

KEPT = 64
"""Number of requests whose motions stay in memory; a download or an edit of them needs no model."""
TIME_LIMIT = 300.0
"""Maximum number of seconds of one request on the model."""
FORMATS = {".bvh": "BVH", ".glb": "GLB", ".npz": "NPZ", ".mp4": "MP4"}
"""Files to download, and their names on the page."""


class Stopped(UserError):
    """The user canceled the request."""


class Studio:
    """Makes the motions of requests with a fixed set of models.

    Args:
        sources: names of models, as for `flame_mdm.load`; requests can choose no other.
        device: of all models.

    Raises:
        UserError, FileNotFoundError: a model cannot be found or loaded; the first is loaded now.
    """

    def __init__(self, sources: Sequence[str], device: str):
        self.device = device
        self.files = {name: find(name) for name in sources}
        self._models: dict[str, MotionGeneration] = {}
        self._made: OrderedDict[tuple[Any, ...], list[Motion]] = OrderedDict()
        self._working = Lock()
        self.model(sources[0])

    def model(self, name: str) -> MotionGeneration:
        """Returns a model by its name in `sources`; loads it at the first request."""
        if name not in self.files:
            near = did_you_mean(name, self.files)
            raise UserError(f"unknown model {name[:60]!r}.{near} This page has: {', '.join(self.files)}")
        if name not in self._models:
            self._models[name] = load(self.files[name], self.device)
        return self._models[name]

    def motions(
        self, request: Request, report: Callable[[int], None] = lambda calls: None, stop: Event | None = None
    ) -> list[Motion]:
        """Returns the motions of a request, from memory if they were made before.

        Args:
            request: what to make.
            report: called before each call of the network, with the number of calls so far.
            stop: once set, the next call raises `Stopped`.

        Raises:
            UserError, ValueError: the model refuses the request, it took too long or was canceled.
        """
        with self._working:
            model = self.model(request.model)
            if model.conditioned_on != "none" and not request.text:
                raise UserError("the text is empty. Describe what the person does")
            parts = read_parts(request.text) if request.text else []
            if sum(seconds or request.seconds for _, seconds in parts) > MAX_SECONDS:
                raise UserError(f"the parts are too long: give at most {MAX_SECONDS} seconds in total")
            steps = request.steps(model.conditioned_on)
            cleanup = bool(steps[-1][1].pop("cleanup", False))
            calls, deadline = 0, time.monotonic() + TIME_LIMIT

            def before(*_: object) -> None:
                nonlocal calls
                if stop is not None and stop.is_set():
                    raise Stopped("canceled")
                if time.monotonic() > deadline:
                    raise UserError(f"stopped after {TIME_LIMIT:g} seconds. Take fewer steps, samples or seconds")
                report(calls)
                calls += 1

            hook = model.denoiser.register_forward_pre_hook(before)
            try:
                motions: list[Motion] = []
                for number, (source, given) in enumerate(steps):
                    key = (request.model, repr(steps[: number + 1]))
                    if key not in self._made:
                        if source is None:
                            self._made[key] = generate(model, **given)
                        elif source >= len(motions):
                            raise UserError(f"motion={source}: there are {len(motions)} motions, numbered from 0")
                        else:
                            self._made[key] = list(edit(model, motions[source], **given))
                    self._made.move_to_end(key)
                    motions = self._made[key]
            finally:
                hook.remove()
            while len(self._made) > KEPT:
                self._made.popitem(last=False)
        contacts = model.representation.contacts
        return [cleaned(motion, contacts(motion.features)) for motion in motions] if cleanup else motions

    def advice(self, request: Request) -> list[str]:
        """Returns warnings of words that the model has never seen."""
        model = self.model(request.model)
        if model.conditioned_on != "text":
            return []
        texts = [part.text for part in (request, *request.edits) if part.text]
        parts = dict.fromkeys(words for text in texts for words, _ in read_parts(text))
        return [line for words in parts for line in advice(words, model.facts, model.condition.max_words)]

    def file(self, request: Request, number: int, extension: str, rig: str | None = None) -> bytes:
        """Returns the bytes of a motion file; `number` counts the motions of the request from 0.

        Raises:
            UserError, ValueError: there is no such motion, format or rig, or as in `motions`.
        """
        if extension not in FORMATS:
            raise UserError(f"{extension[:20]}: not a format of this page. Use {', '.join(FORMATS)}")
        motions = self.motions(request)
        if not 0 <= number < len(motions):
            raise UserError(f"motion={number}: there are {len(motions)} motions, numbered from 0")
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder, f"motion{extension}")
            motions[number].save(path, rig=rig)
            return path.read_bytes()
