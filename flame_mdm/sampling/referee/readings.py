"""`Reading`, the evidence for or against a claim, and helpers that find it in signals."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from flame_mdm.sampling.referee.body import RATE

Spans = tuple[tuple[float, float], ...]

# Units of distances. A smaller distance supports a claim.
AWAY = ("m above the floor", "m apart", "m from")


@dataclass(frozen=True)
class Reading:
    """The measurement for a claim.

    Attributes:
        score: number that is compared with the thresholds of the kind. A higher score supports the
            claim. NaN = undecided.
        number, unit: the measured value, in a readable unit.
        joint: joint or part of the body.
        spans: start and end, in seconds, of each time span where the claim is true or nearly true.
        unclear: reason why a high score does not make the claim true; "" = none.
        signal: values (F,) that show for each frame whether the claim is true, or None if
            individual frames do not show it.
        level: minimum value of `signal` at which the claim is true; None = the middle of the kind's
            band.
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
    """Returns the start and the end, in seconds, of each run of true frames (F,).

    Runs shorter than `shortest` seconds are left out.
    """
    edges = np.flatnonzero(np.diff(np.r_[0, flags.astype(int), 0])).reshape(-1, 2)
    return tuple(
        (start / RATE, end / RATE)
        for start, end in edges.tolist()
        if end - start >= shortest * RATE
    )


def held(signal: np.ndarray, seconds: float) -> float:
    """Returns the highest value that a signal (F,) reaches for `seconds` seconds in total."""
    count = min(len(signal), max(1, round(seconds * RATE)))
    return float(np.sort(signal)[-count])


def existence(
    signal: np.ndarray, unit: str, joint: str, seconds: float = 0.1, share: float = 0.5
) -> Reading:
    """Returns a reading of the value that a signal (F,) reaches for `seconds` seconds.

    The spans are the frames above a level. The level lies between the median and the highest value,
    at the fraction `share`. For a short signal, the lowest value replaces the median.
    """
    score = held(signal, seconds)
    low = float(np.percentile(signal, 20))
    bound = low + share * (score - low)
    # The signal of a distance is negative: a smaller distance supports the claim.
    number = -score if unit.startswith(AWAY) else score
    return Reading(score, number, unit, joint, spans_of(signal >= bound), signal=signal)


def of_side(readings: Sequence[Reading], side: str, margin: float) -> Reading:
    """Returns the reading of a limb, given the readings of the left and the right limb.

    For "both", the lower reading counts. For "", the higher reading counts. The reading of a left
    or right limb is unclear if the readings differ by less than `margin`, because the other limb
    then does the same.
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
    """Returns the frames of the peaks of a signal (F,).

    A peak is `depth` above the valleys on both sides. If a signal begins or ends high, the outer
    valley exists only if the signal returns to a low value within the motion.
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
    """Returns a reading of the number of repetitions, which are peaks of a signal.

    Peaks are counted with a lower and a higher depth. The score is 0 if both counts equal the
    claimed count, and -0.5 if the claimed count is between them. Otherwise, the score is the
    negative distance between the claimed count and the nearest count, at most -1.
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

    In this case, the signal falls by `depth` before it rises by `depth`.
    """
    falls = np.flatnonzero(signal < signal[0] - depth)
    rises = np.flatnonzero(signal > signal[0] + depth)
    return len(falls) > 0 and (len(rises) == 0 or falls[0] < rises[0])
