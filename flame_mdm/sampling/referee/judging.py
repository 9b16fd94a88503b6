"""`judge`: verdicts, with evidence, on the claims in a sentence about a motion."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from flame_mdm.errors import UserError, shortened
from flame_mdm.formats.motion import Motion
from flame_mdm.representations.skeleton import SMPL22
from flame_mdm.sampling.referee.body import RATE, Body
from flame_mdm.sampling.referee.claims import FLIPPED_END, Claim
from flame_mdm.sampling.referee.kinds import KINDS, band, group_of
from flame_mdm.sampling.referee.readings import AWAY, Reading, held, spans_of
from flame_mdm.sampling.referee.sentences import read_claims

Answer = Literal["yes", "no", "cannot tell"]
# Minimum duration of a motion that is judged, in seconds
SHORTEST = 0.4
# Length, in seconds, of the start and the end of a motion, in which postures are measured
END = 0.6
# Time in seconds for which a posture must be held within the start or the end
HELD = 0.2
# Maximum interruption, in seconds, of a state or activity whose duration is measured
BREAK = 0.5


@dataclass(frozen=True)
class Verdict:
    """The verdict on whether a claim about a motion is true, with the evidence.

    Attributes:
        claim: the claim.
        answer: "yes", "no" or "cannot tell".
        reading: the measurement.
        band: two thresholds of the score. The answer is "no" up to the first threshold, "yes" from
            the second threshold on, and "cannot tell" in between.
    """

    claim: Claim
    answer: Answer
    reading: Reading
    band: tuple[float, float]

    @property
    def group(self) -> str:
        """Subject of the claim, such as "side" or "count"."""
        return group_of(self.claim)

    @property
    def evidence(self) -> str:
        """The decisive number, with its joint, unit and times.

        Example: "left wrist: 0.21 m above the head, 1.2-1.9 s".
        """
        reading = self.reading
        shown = ", ".join(f"{start:.1f}-{end:.1f} s" for start, end in reading.spans[:3])
        times = f", {shown}" if shown else ""
        reason = f" ({reading.unclear})" if reading.unclear else ""
        return f"{reading.joint}: {reading.number:.2f} {reading.unit}{times}{reason}"

    def __str__(self) -> str:
        return f"{self.answer}: {self.claim}; {self.evidence}"

    def marks(self, fps: float, frames: int) -> list[tuple[int, int, str, str]]:
        """Returns the time spans of the evidence, in frames, as marks for a player's timeline."""
        marks = []
        for start, end in self.reading.spans[:3]:
            first = min(max(0, round(start * fps)), frames - 1)
            last = min(frames, max(first + 1, round(end * fps)))
            marks.append((first, last, f"{self.answer}: {self.claim}", self.evidence))
        return marks


@dataclass(frozen=True)
class Judgment:
    """The verdicts on all claims in a sentence.

    Attributes:
        text: the sentence.
        verdicts: one verdict per claim, in the order of the claims in the sentence. The list is
            empty if no claim in the sentence can be checked.
    """

    text: str
    verdicts: tuple[Verdict, ...]

    @property
    def decided(self) -> int:
        """Number of claims with the answer "yes" or "no"."""
        return sum(verdict.answer != "cannot tell" for verdict in self.verdicts)

    @property
    def true(self) -> int:
        """Number of claims with the answer "yes"."""
        return sum(verdict.answer == "yes" for verdict in self.verdicts)

    @property
    def accuracy(self) -> float | None:
        """Fraction of the decided claims that are true, or None if none was decided."""
        return self.true / self.decided if self.decided else None

    def __str__(self) -> str:
        if not self.verdicts:
            return f"'{shortened(self.text, 60)}': no claim that can be checked"
        return f"{self.true} of {self.decided} decided claims are true, {len(self.verdicts)} read"


def judge(
    motion: Motion | np.ndarray, text: str | None = None, fps: float | None = None
) -> Judgment:
    """Judges whether a motion does what a sentence says.

    Reads the claims in the sentence and checks each of them by measuring the motion. Each answer is
    "yes", "no" or "cannot tell". docs/referee.md lists the claims that can be checked.

    Args:
        motion: a motion of SMPL's 22 joints, or joint positions (F, 22, 3) in meters, with y up.
        text: the sentence. Default: the motion's own text.
        fps: frames per second; required for joint positions.

    Raises:
        UserError: If the motion does not have SMPL's 22 joints, is shorter than 0.4 seconds or
            contains NaN or infinity, if there is no text, or if joint positions are passed without
            `fps`.
    """
    if isinstance(motion, Motion):
        if motion.skeleton != SMPL22:
            raise UserError(
                f"motion {motion.id!r} has the skeleton {motion.skeleton.name}, but the referee requires {SMPL22.name}"
            )
        joints, fps = motion.joints, motion.fps
        text = motion.text if text is None else text
    else:
        joints = motion
    if fps is None:
        raise UserError(
            "fps is missing: joint positions have no frame rate. Pass one, for example fps=20"
        )
    if not text or not text.strip():
        raise UserError(
            "text is missing, and the motion has none. Pass the sentence to judge the motion by"
        )
    return Judgment(text, tuple(verdicts(joints, fps, read_claims(text))))


def try_judge(motion: Motion) -> Judgment | None:
    """Judges a motion against its own text.

    Returns None if the motion cannot be judged or if its text contains no claim.
    """
    is_long = len(motion.joints) > (SHORTEST + 0.1) * motion.fps
    if motion.skeleton != SMPL22 or not motion.text.strip() or not is_long:
        return None
    judgment = judge(motion)
    return judgment if judgment.verdicts else None


def evidence_marks(motion: Motion) -> list[tuple[int, int, str, str]]:
    """Returns the evidence for the claims in a motion's own text, as marks on a timeline."""
    judgment = try_judge(motion)
    if judgment is None:
        return []
    shown = (verdict.marks(motion.fps, len(motion.joints)) for verdict in judgment.verdicts)
    return [mark for marks in shown for mark in marks]


def claim_score(motions: Sequence[Motion]) -> list[float]:
    """Returns, for each motion, the number of true claims minus the number of false claims.

    The claims are read from the motion's own text. If the text contains no claims, the score is 0.
    """
    judged = [try_judge(motion) for motion in motions]
    return [0.0 if one is None else float(2 * one.true - one.decided) for one in judged]


def verdicts(joints: np.ndarray, fps: float, claims: Sequence[Claim]) -> list[Verdict]:
    """Returns the verdicts on claims about a motion with joint positions (F, 22, 3) in meters."""
    if not claims:
        return []
    body = Body(joints, fps)
    if len(body) < SHORTEST * RATE:
        raise UserError(
            f"the motion is {body.seconds:.2f} s long. The referee requires at least {SHORTEST} s"
        )
    return [decide(body, claim) for claim in claims]


def decide(body: Body, claim: Claim) -> Verdict:
    """Returns the verdict on a claim about a body."""
    if claim.parts:
        reading = _order(body, claim)
    elif claim.seconds is not None:
        reading = _duration(body, claim)
    elif claim.when:
        reading = _at_an_end(body, claim)
    else:
        reading = KINDS[claim.kind].measure(body, claim)
    no, yes = band(claim)
    answer: Answer = "cannot tell"
    if reading.score <= no:
        answer = "no"
    elif reading.score >= yes and not reading.unclear:
        answer = "yes"
    return Verdict(claim, answer, reading, (no, yes))


def _order(body: Body, claim: Claim) -> Reading:
    """Measures the time in seconds between the starts of two events whose order is claimed.

    If an event happens several times, the pair of starts with the largest difference is used. The
    order is undecided if the answer for either event is not "yes", or if the reverse order also
    occurs.
    """
    first, second = (decide(body, part) for part in claim.parts)
    firsts = [start for start, _ in first.reading.spans]
    seconds = [start for start, _ in second.reading.spans]
    if first.answer != "yes" or second.answer != "yes" or not firsts or not seconds:
        return Reading(math.nan, 0.0, "s later", "body", (), "not both parts are clear")
    later, reverse = max(seconds) - min(firsts), max(firsts) - min(seconds)
    unclear = "the reverse order also happens" if min(later, reverse) > 0.3 else ""
    spans = (
        first.reading.spans[firsts.index(min(firsts))],
        second.reading.spans[seconds.index(max(seconds))],
    )
    return Reading(later, later, "s later", "body", spans, unclear)


def _at_an_end(body: Body, claim: Claim) -> Reading:
    """Measures a claim about the start or the end of a motion.

    Postures and contacts are measured in the first or last `END` seconds, and movements in the
    first or second half of the motion. The claim is unclear if the other end shows the same posture
    or movement. Standing is an exception, because it is common at both ends.
    """
    kind = KINDS[claim.kind]
    reading = kind.measure(body, replace(claim, when=""))
    if reading.signal is None:
        return reading
    width = max(1, len(body) // 2)
    if kind.group in ("posture", "contact"):
        width = min(width, round(END * RATE))
    parts = {"start": reading.signal[:width], "end": reading.signal[-width:]}
    score = held(parts[claim.when], HELD)
    other = held(parts[FLIPPED_END[claim.when]], HELD)
    unclear = reading.unclear
    if claim.kind != "upright" and other >= sum(band(claim)) / 2:
        unclear = "the other end of the motion shows the same"
    seconds = width / RATE
    span = (0.0, seconds) if claim.when == "start" else (body.seconds - seconds, body.seconds)
    number = -score if reading.unit.startswith(AWAY) else score
    return replace(reading, score=score, number=number, spans=(span,), unclear=unclear)


def _duration(body: Body, claim: Claim) -> Reading:
    """Measures how long a claim is true, including interruptions of up to `BREAK` seconds.

    The score is -|log2(measured / claimed)|. The claim is undecided unless it is true without its
    duration.
    """
    verdict = decide(body, replace(claim, seconds=None))
    reading = verdict.reading
    undecided = Reading(math.nan, 0.0, "s", reading.joint, (), "it is not clearly visible")
    if verdict.answer != "yes" or reading.signal is None or claim.seconds is None:
        return undecided
    level = sum(verdict.band) / 2 if reading.level is None else reading.level
    joined: list[tuple[float, float]] = []
    for start, end in spans_of(reading.signal >= level, 0.1):
        if joined and start - joined[-1][1] <= BREAK:
            joined[-1] = (joined[-1][0], end)
        else:
            joined.append((start, end))
    if not joined:
        return undecided
    longest = max(joined, key=lambda span: span[1] - span[0])
    lasting = longest[1] - longest[0]
    score = -abs(math.log2(lasting / claim.seconds))
    return Reading(score, lasting, "s", reading.joint, (longest,))
