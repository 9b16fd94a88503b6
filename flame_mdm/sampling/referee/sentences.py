"""Rules for reading the claims in a sentence. Parts that are not understood are ignored.

The rules aim at precision rather than completeness. The patterns are in `sentences.yaml`, and the
verb forms are in `flame_mdm.conditions.language`. Sentences with a negation, an alternative or
several people are ignored, and so are comparisons ("like a zombie") and everything else that
matches no pattern.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

from flame_mdm.conditions.language.morphology import inflections
from flame_mdm.conditions.language.tables import phrases, word_values
from flame_mdm.safe_io import read_package_yaml
from flame_mdm.sampling.referee.claims import Claim, unique
from flame_mdm.sampling.referee.kinds import KINDS, ORDER

BOUNDARY = re.compile(
    r"\s*(?:[.;:!?,|]|\b(?:and then|then|followed by|and|while|whilst|as|before|after|but|when|until)\b)\s*"
)
LATER = ("then", "followed by", "before", "|")
SIDES = re.compile(r"\b(left|right)\b")
# Maximum length of a sentence in characters. The rest is ignored.
LONGEST = 600
COUNT_NOUNS = {
    "count jumps": "jumps?|hops?|leaps?",
    "count squats": "squats?",
    "count bends": "bows?",
    "count claps": "claps?",
    "count jumping jacks": "jumping jacks?",
    "count push-ups": "push ?ups?",
    "count kicks": "(?:\\w+ )?kicks?",
    "count punches": "(?:\\w+ )?(?:punches|punch|jabs?)",
    "count raises": "(?!)",
    "steps": "(?:\\w+ )?(?:steps|paces|strides)",
}
MOVING = {"walk", "run", "travel", "step", "jump", "hop", "veer", "circle", "turn around"}
POSTURES = {
    "sit",
    "kneel",
    "lie",
    "all fours",
    "crouch",
    "bend",
    "raise hand",
    "hand above head",
    "hand on hip",
    "arms out",
    "arms crossed",
}
LASTING = {"walk", "run", "stand still", *POSTURES}
"""Kinds of claims that may state a duration."""
AT_AN_END = {"walk", "run", "jump", "hop", "kick", "strike", *POSTURES}
"""Kinds of claims that may refer to the start or the end."""
DIRECTIONS = {
    "forward": "forwards?|forewards?|ahead|straight ahead",
    "backward": "backwards?|backwords?",
}
"""Words for a direction of travel.

"Back" is not listed, because "walks back" may mean to return.
"""


@dataclass(frozen=True)
class Clause:
    """A clause, with a flag for events that happen after the events of the previous clause."""

    text: str
    is_later: bool


@dataclass(frozen=True)
class Pattern:
    """A pattern for claims: one row of `sentences.yaml`."""

    kind: str
    when: re.Pattern[str]
    take: tuple[str, ...]
    unless: re.Pattern[str] | None


def read_claims(text: str) -> list[Claim]:
    """Returns the claims in a sentence in order, without duplicates.

    The list is empty if the sentence contains no claim that can be checked.
    """
    plain = _plain(text)
    if any(pattern.search(plain) for pattern in _unread()):
        return []
    claims: list[Claim] = []
    orders: list[Claim] = []
    before: list[Claim] = []
    clauses = _clauses(plain)
    for number, clause in enumerate(clauses):
        current = _of_clause(clause.text)
        claims += _at_ends(clause, is_last=number == len(clauses) - 1)
        claims += _lasting(clause.text, current)
        if not current:
            continue
        if clause.is_later:
            orders += _orders(before, current)
        before = current
        claims += current
    return unique([*_consistent(claims, plain), *orders])


def _plain(text: str) -> str:
    """Converts text to lower case and removes hyphens and apostrophes.

    Phrases that contain a connective are joined into one word.
    """
    plain = re.sub(r"[-'’\"]", " ", text[:LONGEST].lower())
    plain = re.sub(r"\b(?:counter|anti) ?clockwise\b", "counterclockwise", plain)
    plain = re.sub(r"\s+", " ", plain).strip()
    for pattern, word in _content()["joined"]:
        plain = re.sub(rf"\b(?:{pattern})\b", word, plain)
    return plain


def _clauses(plain: str) -> list[Clause]:
    """Splits a sentence into clauses at its connectives, and truncates clauses at comparisons."""
    clauses: list[Clause] = []
    start, is_later = 0, False
    for match in [*BOUNDARY.finditer(plain), None]:
        end = len(plain) if match is None else match.start()
        text = _hedges().split(plain[start:end])[0].strip()
        if text:
            clauses.append(Clause(text, is_later))
        if match is None:
            break
        connective = match[0].strip()
        is_later = any(word in connective for word in LATER) or (is_later and not text)
        start = match.end()
    return clauses


def _of_clause(text: str) -> list[Claim]:
    claims: list[Claim] = []
    for pattern in _patterns():
        match = pattern.when.search(text)
        if match is None or (pattern.unless is not None and pattern.unless.search(text)):
            continue
        claims += _claims(pattern, text)
    counts = [claim for claim in claims if claim.kind.startswith("count")]
    if len({claim.kind for claim in counts}) > 1:
        claims = [claim for claim in claims if claim not in counts]
    return claims


def _at_ends(clause: Clause, *, is_last: bool) -> list[Claim]:
    """Returns a clause's claims about the start or end of the motion, as in "ends seated"."""
    text, returns = clause.text, _content()["returns"]
    for kind in ("return pose", "return place"):
        if re.search(rf"\b(?:{returns[kind]})\b", text):
            return [Claim(kind, text)]
    when = ""
    if _has(text, "end") or (is_last and _has(text, "return")):
        when = "end"
    elif not clause.is_later and _has(text, "start"):
        when = "start"
    if not when:
        return []
    claims: list[Claim] = []
    for state in _states():
        if state.when.search(text) and not (state.unless and state.unless.search(text)):
            claims += _claims(state, text)
    # "Starts to walk" may mean that the person was standing before.
    if not claims and (when == "end" or _has(text, "by")):
        claims = [claim for claim in _of_clause(text) if claim.kind in AT_AN_END]
    return [replace(claim, when=when) for claim in claims]


def _has(text: str, key: str) -> bool:
    """Returns whether a clause matches the pattern `key` under `ends` in `sentences.yaml`."""
    return re.search(rf"\b(?:{_content()['ends'][key]})\b", text) is not None


def _lasting(text: str, claims: Sequence[Claim]) -> list[Claim]:
    """Returns the claims about a duration in a clause, as in "stands still for three seconds"."""
    numbers = {word: int(value) for word, value in phrases()["numbers"].items()}
    number = "|".join([r"\d{1,2}", *numbers])
    match = re.search(rf"\bfor (?:\w+ )?({number}) (?:\w+ )?(?:seconds?|secs?|s)\b", text)
    if match is None:
        return []
    seconds = numbers[match[1]] if match[1] in numbers else int(match[1])
    lasting = [claim for claim in claims if claim.kind in LASTING]
    return [replace(claim, seconds=seconds) for claim in lasting] if seconds else []


def _claims(pattern: Pattern, text: str) -> list[Claim]:
    """Returns the claims that a matching pattern reads from a clause."""
    claim = Claim(pattern.kind, text)
    side = _side(text, "legs" if "side of a leg" in " ".join(pattern.take) else "hands")
    if any("side of a" in take for take in pattern.take):
        if side is None or (not side and any(take.startswith("needed") for take in pattern.take)):
            return []
        if any(take.startswith("needed") for take in pattern.take) and side == "both":
            return []
        claim = replace(claim, side=side)
    claims: list[Claim] = []
    if "turn" in pattern.take:
        claims += _turns(claim, text)
    elif pattern.kind == "circle":
        claims.append(replace(claim, direction=_way(text) or ""))
    elif pattern.kind == "lean":
        direction = _way(text)
        claims += [replace(claim, direction=direction)] if direction else []
    elif pattern.kind:
        claims.append(claim)
    for take in pattern.take:
        claims += _further(take, claim, text)
    return claims


def _further(take: str, claim: Claim, text: str) -> list[Claim]:
    """Returns the claims that a clause makes in addition to the claim of its pattern."""
    if take == "travel" or take == "jumped":
        direction = _direction(text)
        kind = "step" if take == "jumped" or claim.kind == "step" else "travel"
        return [Claim(kind, text, direction=direction)] if direction else []
    if take == "way" and (direction := _way(text)) in ("left", "right"):
        return [] if _is_turning(text) else [Claim("veer", text, direction=direction)]
    if take == "pace" and (speed := _speed(text)):
        return [Claim("pace", text, speed=speed)]
    if take.startswith("count") and (amount := _amount(text, take)) is not None:
        return [Claim(take, text, side=claim.side, amount=amount)]
    if take == "steps" and (amount := _amount(text, take)) is not None and 2 <= amount <= 12:
        return [Claim("count steps", text, amount=amount)]
    return []


def _turns(claim: Claim, text: str) -> list[Claim]:
    """Returns the claims about a turn: its existence, its direction and its angle."""
    direction = _way(text) or ""
    angle = re.search(r"\b(45|90|180|270|360)\b", text)
    claims = [replace(claim, direction=direction)]
    if angle is not None:
        claims.append(Claim("turn angle", text, direction=direction, amount=int(angle[1])))
    elif re.search(r"\bquarter turn\b", text):
        claims.append(Claim("turn angle", text, direction=direction, amount=90))
    return claims


def _is_turning(text: str) -> bool:
    return any(pattern.when.search(text) for pattern in _patterns() if "turn" in pattern.take)


def _way(text: str) -> str | None:
    """Returns the direction that a clause states: left, right, clockwise or counterclockwise.

    Returns None if the clause states no direction or several directions.
    """
    ways = set()
    for match in re.finditer(r"\b(left|right|clockwise|counterclockwise)\b", text):
        after = text[match.end() :].split()[:1]
        if after and re.fullmatch(rf"(?:{_sided_words()})(?:s|ed)?", after[0]):
            continue
        ways.add(match[1])
    if "bothsides" in text or "sidetoside" in text:
        return None
    return ways.pop() if len(ways) == 1 else None


def _direction(text: str) -> str:
    """Returns the direction of travel that a clause states: forward or backward.

    Returns "" if the clause states neither or both, or if the direction is diagonal.
    """
    if re.search(r"\b(?:diagonal|diagonally|sideways|backandforth|zig ?zag)\b", text):
        return ""
    stated = [name for name, words in DIRECTIONS.items() if re.search(rf"\b(?:{words})\b", text)]
    if re.search(
        r"\b(?:lean|leaning|leans|bent|bending|facing|reach\w*|stretch\w*|arms?|hands?)\b", text
    ):
        return ""
    if not stated and re.search(r"\b(?:steps?|stepping|stepped) back\b", text):
        return "backward"
    return stated[0] if len(stated) == 1 else ""


def _side(text: str, limb: str) -> str | None:
    """Returns the side of a limb in a clause: left, right or both, or "" if no side is stated.

    Returns None if the side is ambiguous.
    """
    limbs = _content()[limb]
    stated = {match[1] for match in re.finditer(rf"\b(left|right) (?:\w+ )?(?:{limbs})\b", text)}
    if limb == "hands":
        stated |= set(re.findall(r"\bwith (?:the |his |her |their )?(left|right)$", text))
    if "bothsides" in text or len(stated) > 1 or "other" in text.split():
        return None
    if stated:
        return stated.pop()
    # "Kicks his legs" does not mean that both legs kick at the same time.
    if limb == "legs" or re.search(r"\bone of\b", text):
        return ""
    return "both" if re.search(r"\b(?:hands|arms|fists|wrists)\b", text) else ""


def _amount(text: str, kind: str) -> int | None:
    """Returns the number of repetitions that a clause states for a kind of claim, or None."""
    numbers = {word: int(value) for word, value in phrases()["numbers"].items()}
    number = "|".join([r"\d{1,2}", *numbers])
    nouns = COUNT_NOUNS[kind]
    match = re.search(rf"\b({number}) (?:(?:\w+ )?)?(?:{nouns})\b", text)
    if match is None and kind != "steps":
        match = re.search(rf"\b({number}) times\b", text)
    if match is not None:
        return numbers[match[1]] if match[1] in numbers else int(match[1])
    if kind == "steps":
        return None
    for word, times in phrases()["times"].items():
        if re.search(rf"(?<!at )\b{word}\b(?! (?:again|more|he|she|they|it|a|the)\b)", text):
            return int(times)
    return None


def _speed(text: str) -> str:
    """Returns "slow" or "fast" if the clause states one of these speeds and no other.

    Returns "" if the clause states both of these speeds, another speed, or none.
    """
    words = text.split()
    values = {value for word, value in word_values("speed").items() if word in words}
    return values.pop() if values in ({"slow"}, {"fast"}) else ""


def _orders(before: Sequence[Claim], after: Sequence[Claim]) -> list[Claim]:
    """Returns the claim that a clause's first event precedes the first event of the next clause."""
    first = next((claim for claim in before if _is_event(claim)), None)
    second = next((claim for claim in after if _is_event(claim)), None)
    if first is None or second is None or first.kind == second.kind:
        return []
    return [Claim(ORDER, f"{first.words}, then {second.words}", parts=(first, second))]


def _is_event(claim: Claim) -> bool:
    if claim.when or claim.seconds is not None:
        return False
    return not claim.parts and KINDS[claim.kind].is_timed and claim.kind not in ("step", "use hand")


def _consistent(claims: Sequence[Claim], plain: str) -> list[Claim]:
    """Removes the claims that the rest of the sentence makes doubtful.

    A body that also travels does not stand still all the time, and a person who stands up after a
    bow was already standing. A sentence that names both sides does not claim that one side moves
    more.
    """
    doubtful: set[str] = set()
    kinds = {claim.kind for claim in claims}
    if kinds & MOVING:
        doubtful.add("stand still")
    if kinds & {"bend", "head down"} and not kinds & {"sit", "kneel", "crouch", "lie", "all fours"}:
        doubtful.add("stand up")
    if kinds & MOVING:
        # After a walk, the "starting position" may be a location.
        doubtful.add("return pose")
    for kind, limb in (("use hand", "hands"), ("use foot", "legs")):
        sides = re.findall(rf"\b(left|right)(?: \w+)? (?:{_content()[limb]})\b", plain)
        if len(set(sides)) > 1 or "other" in plain.split():
            doubtful.add(kind)
    return [claim for claim in claims if claim.kind not in doubtful]


@cache
def _content() -> dict[str, Any]:
    return read_package_yaml(Path(__file__).with_suffix(".yaml"))


@cache
def _sided_words() -> str:
    """Returns a pattern for words that can have a side, as in "left hand"."""
    return "|".join(phrases()["sides_of"].split())


def _expanded(pattern: str) -> re.Pattern[str]:
    """Compiles a pattern from `sentences.yaml`."""
    content = _content()
    pattern = re.sub(r"\s+(?=\[)", "", pattern) if pattern.startswith(r"\b(?:like") else pattern
    pattern = re.sub(r"\[(\w+)\]", lambda match: _forms(match[1]), pattern)
    for name in ("hands", "legs", "of"):
        pattern = pattern.replace(f"{{{name}}}", content[name])
    return re.compile(rf"(?<!\w)(?:{pattern})(?!\w)")


def _forms(verb: str) -> str:
    return f"(?:{'|'.join(inflections(verb))})"


@cache
def _patterns() -> tuple[Pattern, ...]:
    return tuple(_pattern(row) for row in _content()["claims"])


@cache
def _states() -> tuple[Pattern, ...]:
    return tuple(_pattern(row) for row in _content()["states"])


def _pattern(row: dict[str, Any]) -> Pattern:
    return Pattern(
        row["kind"],
        _expanded(row["when"]),
        tuple(row["take"] if isinstance(row["take"], list) else ()),
        _expanded(row["unless"]) if "unless" in row else None,
    )


@cache
def _unread() -> tuple[re.Pattern[str], ...]:
    return tuple(re.compile(pattern) for pattern in _content()["unread"])


@cache
def _hedges() -> re.Pattern[str]:
    return _expanded(_content()["hedges"])
