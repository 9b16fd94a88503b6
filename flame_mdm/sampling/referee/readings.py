"""`Reading`, the evidence for or against a claim, and helpers that find it in signals over time."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from flame_mdm.sampling.referee.body import RATE

Spans = tuple[tuple[float, float], ...]

# Units of distances: a smaller distance speaks for a claim
AWAY = ("m above the floor", "m apart", "m from")


@dataclass(frozen=True)
class Reading:
    """What was measured for a claim.

    Attributes:
        score: number that is compared with the thresholds of the kind; higher speaks for the claim. NaN is undecided.
        number, unit: what was measured, in a unit that people read.
        joint: joint or part of the body.
        spans: first and last second of each time at which the claim is true, or nearly.
        unclear: reason why a high score does not make the claim true; "" = none.
        signal: values (F,) that show by frame whether it is so; None if single frames do not show it.
        level: value of `signal` from which it is so; None = the middle of the band of the kind.
    """

    score: float
    number: float
    unit: str
    joint: str = "body"
    spans: Spans = ()
    unclear: str = ""
    signal: np.ndarray | None = field(default=None, compare=False, repr=False)
    level: float | None = None


def spans_of(flags: np.ndarray, shortest: float = 0.0) -> Spans:
    """Returns first and last second of each run of true frames (F,) of at least `shortest` seconds."""
    edges = np.flatnonzero(np.diff(np.r_[0, flags.astype(int), 0])).reshape(-1, 2)
    return tuple(
        (start / RATE, end / RATE)
        for start, end in edges.tolist()
        if end - start >= shortest * RATE
    )


def held(signal: np.ndarray, seconds: float) -> float:
    """Returns the highest value that a signal (F,) keeps for some seconds in total."""
    count = min(len(signal), max(1, round(seconds * RATE)))
    return float(np.sort(signal)[-count])


def existence(
    signal: np.ndarray, unit: str, joint: str, seconds: float = 0.1, share: float = 0.5
) -> Reading:
    """Returns a reading of how high a signal (F,) gets for `seconds`.

    The spans are the frames above a share of the way from the median, or from the lowest value of a short signal, to
    the highest value.
    """
    score = held(signal, seconds)
    low = float(np.percentile(signal, 20))
    bound = low + share * (score - low)
    # a signal of a distance is negative: less speaks for the claim
    number = -score if unit.startswith(AWAY) else score
    return Reading(score, number, unit, joint, spans_of(signal >= bound), signal=signal)


def of_side(readings: Sequence[Reading], side: str, margin: float) -> Reading:
    """Returns the reading of a limb, from the readings of the left and the right one.

    For "both", the lower reading counts, and for "", the higher one. A left or right limb is unclear if the other one
    shows the same: less than `margin` separates them.
    """
    left, right = readings
    if side == "both":
        lower = min(readings, key=lambda reading: reading.score)
        limb = lower.joint.partition(" ")[2]
        joint = "both feet" if limb == "foot" else f"both {limb}s"
        if left.signal is None or right.signal is None:
            return replace(lower, joint=joint)
        return replace(lower, joint=joint, signal=np.minimum(left.signal, right.signal))
    if side == "":
        return max(readings, key=lambda reading: reading.score)
    chosen, other = (left, right) if side == "left" else (right, left)
    if chosen.score - other.score < margin:
        return replace(chosen, unclear=f"the {other.joint} does the same")
    return chosen


def cycles(signal: np.ndarray, depth: float) -> list[int]:
    """Returns the frames of the peaks of a signal (F,) that rise by `depth` above the valleys on both sides.

    A signal that begins or ends high has a valley there only if it comes back down within the motion.
    """
    peaks: list[int] = []
    low, high, at = signal[0], -np.inf, 0
    rising = False
    for frame, value in enumerate(signal):
        if not rising:
            low = min(low, value)
            if value > low + depth:
                rising, high, at = True, value, frame
            continue
        if value > high:
            high, at = value, frame
        elif value < high - depth:
            peaks.append(at)
            rising, low = False, value
    return peaks


def counted(
    signal: np.ndarray, depths: tuple[float, float], amount: int | None, joint: str, unit: str
) -> Reading:
    """Returns a reading of how often a signal repeats: it counts the peaks, with a lower and a higher depth.

    The score is minus the distance between the claimed count and the counts for both depths: 0 if both are the claimed
    one, -0.5 if one of them is, at most -1 if the claimed count is outside of them.
    """
    loose, strict = (cycles(signal, depth) for depth in depths)
    few, many = sorted((len(strict), len(loose)))
    many += _is_cut(signal, depths[0]) + _is_cut(signal[::-1], depths[0])
    claimed = 1 if amount is None else amount
    if few == many == claimed:
        score = 0.0
    elif few <= claimed <= many:
        score = -0.5
    else:
        score = -float(max(few - claimed, claimed - many))
    spans = tuple((frame / RATE, frame / RATE) for frame in loose)
    return Reading(score, float(len(loose)), unit, joint, spans)


def _is_cut(signal: np.ndarray, depth: float) -> bool:
    """Returns whether a signal (F,) begins in a repetition: it falls by `depth` before it rises by it."""
    falls = np.flatnonzero(signal < signal[0] - depth)
    rises = np.flatnonzero(signal > signal[0] + depth)
    return len(falls) > 0 and (len(rises) == 0 or falls[0] < rises[0])
