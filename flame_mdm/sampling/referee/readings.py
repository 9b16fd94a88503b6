"""`Reading`: the evidence for or against a claim, and functions that find evidence in signals."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from flame_mdm.sampling.referee.body import RATE

Spans = tuple[tuple[float, float], ...]

# Units of distances that support a claim when they are small
AWAY = ("m above the floor", "m apart", "m from")


@dataclass(frozen=True)
class Reading:
    """The measurement for a claim.

    Attributes:
        score: number that is compared with the thresholds of the kind. Higher scores support the
            claim. NaN = undecided.
        number, unit: the measured value, in a readable unit.
        joint: joint or body part that was measured.
        spans: start and end, in seconds, of each time span in which the claim is true or nearly
            true.
        unclear: reason why the claim is undecided despite a high score; "" = none.
        signal: values (F,) that show in which frames the claim is true, or None if single frames
            cannot show this.
        level: minimum value of `signal` at which the claim is true, or None for the middle of the
            kind's band.
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
    """Returns the start and end times, in seconds, of stretches of True values in `flags` (F,).

    Stretches shorter than `shortest` seconds are omitted.
    """
    edges = np.flatnonzero(np.diff(np.r_[0, flags.astype(int), 0])).reshape(-1, 2)
    return tuple(
        (start / RATE, end / RATE)
        for start, end in edges.tolist()
        if end - start >= shortest * RATE
    )


def held(signal: np.ndarray, seconds: float) -> float:
    """Returns the highest value that a signal (F,) reaches or exceeds for `seconds` in total."""
    count = min(len(signal), max(1, round(seconds * RATE)))
    return float(np.sort(signal)[-count])


def existence(
    signal: np.ndarray, unit: str, joint: str, seconds: float = 0.1, share: float = 0.5
) -> Reading:
    """Returns a reading of the highest value that a signal (F,) holds for `seconds` seconds.

    The spans consist of the frames above a level. This level is the fraction `share` of the way
    from the signal's 20th percentile to that highest value.
    """
    score = held(signal, seconds)
    low = float(np.percentile(signal, 20))
    bound = low + share * (score - low)
    # The signal of a distance is negated, because smaller distances support the claim.
    number = -score if unit.startswith(AWAY) else score
    return Reading(score, number, unit, joint, spans_of(signal >= bound), signal=signal)


def of_side(readings: Sequence[Reading], side: str, margin: float) -> Reading:
    """Combines the readings of the left and the right limb into the reading for a side.

    "both" uses the lower reading, and "" uses the higher one. For "left" and "right", the
    reading is unclear if the two readings differ by less than `margin`, because the other limb then
    does the same.
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
    """Returns the frames in which a signal (F,) has peaks.

    A peak is more than `depth` above the valleys on both sides. If a signal begins or ends high,
    the outer valley exists only if the signal returns to a low value within the motion.
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
    """Returns a reading of the number of repetitions, counted as peaks of a signal.

    Peaks are counted twice, with a lower and a higher minimum depth. The score is 0 if both counts
    equal the claimed count, and -0.5 if the claimed count lies between them. Otherwise, the score
    is minus the difference between the claimed count and the nearer of the two counts, so it is at
    most -1.
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
    """Returns whether a signal (F,) begins in the middle of a repetition.

    A signal begins in the middle of a repetition if it falls by `depth` before it rises by `depth`.
    """
    falls = np.flatnonzero(signal < signal[0] - depth)
    rises = np.flatnonzero(signal > signal[0] + depth)
    return len(falls) > 0 and (len(rises) == 0 or falls[0] < rises[0])
