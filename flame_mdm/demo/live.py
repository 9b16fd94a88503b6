"""Motion streams for visitors.

The number of streams is limited, and blocks are computed one at a time.
"""

import secrets
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np

from flame_mdm.errors import UserError
from flame_mdm.formats.motion import Motion
from flame_mdm.generator import MotionGenerator
from flame_mdm.representations.humanml import HumanML
from flame_mdm.sampling.streams import Stream, read_text, stream
from flame_mdm.visualize.player import packed_motion

MAX_STREAMS = 16
# Time in seconds without a request after which a stream ends
IDLE = 120.0
# Maximum duration of a stream in seconds
LONGEST = 3600.0
# Maximum number of blocks that a stream may compute in a burst, and per second on average
BURST, RATE = 8.0, 2.0
# Length in seconds of the part at the end of a stream that can be downloaded
KEPT = 60.0
# Number of preceding frames on which the rotations in the first frames of a block depend
BEFORE = 10
ENDINGS = (".bvh", ".glb")
STAND, WALK = "a person stands", "a person walks forward"
"""Text with which a stream begins, and text while the person walks to a waypoint."""


@dataclass
class LiveStream:
    """A visitor's stream and the data that is stored for it.

    Attributes:
        stream: the stream.
        used: time of the last request, in seconds.
        joints: (F, J, 3) joint positions in the last minute of the stream.
        text: the current text.
        allowance: number of blocks that the stream may compute now.
    """

    stream: Stream
    used: float
    joints: np.ndarray
    text: str
    allowance: float = field(default=BURST)


class LiveStreams:
    """The streams of all visitors, generated with one model.

    Args:
        model: a model that continues frames.
        clock: function that returns the time in seconds.
    """

    def __init__(self, model: MotionGenerator, clock: Callable[[], float] = time.monotonic):
        self.model, self.clock = model, clock
        self._streams: dict[str, LiveStream] = {}
        self._working = Lock()

    @property
    def can_lead(self) -> bool:
        """Whether visitors can lead the person along waypoints.

        Waypoints require the representation `HumanML` and a model that understands the text `WALK`.
        """
        if not isinstance(self.model.representation, HumanML):
            return False
        try:
            read_text(self.model, WALK)
        except UserError:
            return False
        return True

    def block(
        self, name: str, text: str, begin: int, path: Sequence[tuple[float, float]] = ()
    ) -> dict[str, Any]:
        """Returns the frames of a stream, starting at frame `begin`, in the player's format.

        Args:
            name: name of the stream, or "" to begin a new stream, whose name is in the result.
            text: description of the motion.
            begin: index of the first frame to return. Existing frames of the stream at or after
                this index are dropped and replaced.
            path: waypoints (x, z), in meters, that are still ahead in frame `begin`. `reached` in
                the result lists the indices of the frames in which waypoints are reached, in order.

        Raises:
            UserError: If the text is not understood, if the stream has ended, or if a limit is
                reached.
        """
        with self._working:
            read_text(self.model, text)
            name, live = self._opened(name, text)
            self._count(live)
            first = live.stream.frames - len(live.joints)
            live.stream.lead(path)
            if begin != live.stream.frames:
                live.stream.go_back(begin / self.model.representation.fps)
            if text != live.text:
                live.stream.change(text)
                live.text = text
            block = next(live.stream)

            before = live.joints[: begin - first]
            live.joints = np.concatenate([before, block.joints])[-round(KEPT * block.fps) :]
        context = before[-BEFORE:]
        joints = np.concatenate([context, block.joints])
        motion = packed_motion(Motion(joints, block.fps, block.skeleton, text), len(context))
        return {
            "stream": name,
            "from": begin,
            "frames": len(block.joints),
            "reached": live.stream.reached,
            "motion": motion,
        }

    def file(self, name: str, ending: str) -> bytes:
        """Returns the contents of a motion file that contains the last minute of a stream.

        Raises:
            UserError: If the stream has ended, or if no file format has this extension.
        """
        if ending not in ENDINGS:
            raise UserError(
                f"{ending[:20]}: a stream cannot be saved in this format. Use one "
                f"of {', '.join(ENDINGS)}"
            )
        with self._working:
            live = self._running(name)
            joints, text = live.joints, live.text
        representation = self.model.representation
        motion = Motion(joints, representation.fps, representation.skeleton, text)
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder, f"stream{ending}")
            motion.save(path)
            return path.read_bytes()

    def _opened(self, name: str, text: str) -> tuple[str, LiveStream]:
        """Returns a stream and its name, after ending the streams that are no longer in use."""
        now = self.clock()
        self._streams = {
            other: live for other, live in self._streams.items() if now - live.used <= IDLE
        }
        if name:
            return name, self._running(name)
        if len(self._streams) >= MAX_STREAMS:
            raise UserError("too many streams are running at the moment. Try again in two minutes")
        name = secrets.token_hex(16)
        nothing = np.zeros((0, len(self.model.representation.skeleton), 3), np.float32)
        self._streams[name] = LiveStream(stream(self.model, text), now, nothing, text)
        return name, self._streams[name]

    def _running(self, name: str) -> LiveStream:
        """Returns the stream with the given name. Raises `UserError` if the stream has ended."""
        if name not in self._streams:
            raise UserError("this stream has ended. Reload the page to start another one")
        return self._streams[name]

    def _count(self, live: LiveStream) -> None:
        """Counts a block toward the limits of a stream.

        Raises `UserError` if a stream computes blocks faster than a visitor can watch them, or if
        it has reached its maximum duration.
        """
        now = self.clock()
        live.allowance = min(BURST, live.allowance + RATE * (now - live.used))
        live.used = now
        if live.allowance < 1:
            raise UserError("too many changes in a short time. Wait a few seconds")
        live.allowance -= 1
        if live.stream.frames > LONGEST * self.model.representation.fps:
            raise UserError(
                "this stream has reached the limit of one hour. Reload the page to start "
                "another one"
            )
