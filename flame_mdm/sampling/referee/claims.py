"""Claims: the checkable statements in a sentence about a motion, and false variants of them."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

MIRRORED = {
    "left": "right",
    "right": "left",
    "clockwise": "counterclockwise",
    "counterclockwise": "clockwise",
}
FLIPPED = {**MIRRORED, "forward": "backward", "backward": "forward"}
FLIPPED_SPEED = {"slow": "fast", "fast": "slow"}
FLIPPED_END = {"start": "end", "end": "start"}
EXCLUDED = {"upright": "lie", "sit": "upright", "kneel": "upright", "lie": "upright"}
"""For each posture, another one that a body cannot have at the same time."""


@dataclass(frozen=True)
class Claim:
    """A checkable statement in a sentence about a motion.

    Attributes:
        kind: what is claimed, a key of `flame_mdm.sampling.referee.kinds.KINDS`.
        words: the part of the sentence that states the claim.
        side: side of the limb: "left", "right" or "both"; "" = any side.
        direction: "forward", "backward", "left", "right", "clockwise" or "counterclockwise"; "" =
            any direction.
        speed: "slow" or "fast"; "" = any speed.
        amount: number of repetitions or steps, or the angle of a turn in degrees; None if not
            stated.
        when: "start" or "end" if the claim is about the start or the end of the motion; "" = at any
            time.
        seconds: claimed duration, or None if not stated.
        parts: for a claim about order, the claims about the two events, in the claimed order.
    """

    kind: str
    words: str = ""
    side: str = ""
    direction: str = ""
    speed: str = ""
    amount: int | None = None
    when: str = ""
    seconds: int | None = None
    parts: tuple["Claim", ...] = ()

    def __str__(self) -> str:
        if self.parts:
            return f"{self.parts[0]}, then {self.parts[1]}"
        amount = "" if self.amount is None else str(self.amount)
        seconds = "" if self.seconds is None else f"for {self.seconds} s"
        when = f"at the {self.when}" if self.when else ""
        values = (self.side, self.direction, self.speed, amount, when, seconds)
        stated = ", ".join(value for value in values if value)
        return f"{self.kind}: {stated}" if stated else self.kind

    @property
    def mirrored(self) -> "Claim":
        """The same claim about the mirror image of the motion."""
        return replace(
            self,
            side=MIRRORED.get(self.side, self.side),
            direction=MIRRORED.get(self.direction, self.direction),
            parts=tuple(part.mirrored for part in self.parts),
        )


def falsified(claim: Claim) -> list[tuple[str, Claim]]:
    """Returns changed versions of a claim, each with its kind of change.

    If the claim is true, all changed versions are false. The kinds of change are "side",
    "direction", "speed", "count" (one more, and one fewer), "duration" (twice as long, and half as
    long), "start or end" (the other end), "posture" (one that the body cannot have at the same time
    as the claimed posture) and "order".
    """
    if claim.parts:
        return [("order", replace(claim, parts=claim.parts[::-1]))]
    wrong: list[tuple[str, Claim]] = []
    if claim.side in MIRRORED:
        wrong.append(("side", replace(claim, side=MIRRORED[claim.side])))
    if claim.direction in FLIPPED:
        wrong.append(("direction", replace(claim, direction=FLIPPED[claim.direction])))
    if claim.speed in FLIPPED_SPEED:
        wrong.append(("speed", replace(claim, speed=FLIPPED_SPEED[claim.speed])))
    if claim.amount is not None and claim.kind.startswith("count"):
        counts = (claim.amount - 1, claim.amount + 1)
        wrong += [("count", replace(claim, amount=count)) for count in counts if count > 0]
    if claim.seconds is not None:
        durations = (claim.seconds * 2, claim.seconds // 2)
        wrong += [("duration", replace(claim, seconds=value)) for value in durations if value > 0]
    if claim.when and claim.kind in EXCLUDED:
        wrong.append(("posture", replace(claim, kind=EXCLUDED[claim.kind])))
    # Most motions begin and end with a standing person.
    if claim.when and claim.kind not in ("upright", "return pose", "return place"):
        wrong.append(("start or end", replace(claim, when=FLIPPED_END[claim.when])))
    return wrong


def unique(claims: Sequence[Claim]) -> list[Claim]:
    """Returns the claims without duplicates.

    Claims that differ only in their words are duplicates.
    """
    kept: dict[Claim, Claim] = {}
    for claim in claims:
        kept.setdefault(_without_words(claim), claim)
    return list(kept.values())


def _without_words(claim: Claim) -> Claim:
    return replace(claim, words="", parts=tuple(_without_words(part) for part in claim.parts))
