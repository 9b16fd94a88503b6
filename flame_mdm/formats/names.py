"""Matches joint names.

The Blender extension also contains this file, so it uses only the standard library.

Programs spell the same joint in many ways: `mixamorig:LeftUpLeg`, `Character1_LeftUpLeg`, `Actor
left up leg`, `L_UpLeg`. Case, separators, and a prefix shared by many joints are ignored. A letter
or a word at the beginning or the end of a name may mark the side.
"""

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import NamedTuple

# Marks of the left and the right side in names
SIDES = (("left", "l"), ("right", "r"))
# Minimum number of joints that share a prefix; skeletons without hands have about 20 joints
SHARED = 10
# Maximum number of prefixes that are tried
PREFIXES = 16
# A prefix that need not be followed by a separator
JOINED = re.compile(r"mixamorig\d*")


class Match(NamedTuple):
    """The skeleton that best matches a list of joint names.

    Attributes:
        skeleton: key of the skeleton.
        numbers: indices of the joints to which each name in the skeleton may refer. A name with
            several indices is ambiguous.
        missing: names in the skeleton that do not match any joint.
    """

    skeleton: str
    numbers: dict[str, list[int]]
    missing: list[str]


def plain(name: str) -> str:
    """Returns a name in lower case, without separators and other special characters."""
    return re.sub(r"[\W_]", "", name).lower()


def spellings(name: str, opposite: str) -> list[str]:
    """Returns the `plain` spellings of a name, beginning with the name itself.

    `opposite` is the name of the counterpart on the other side. A letter or a word before or after
    the rest of the name may mark the side: LeftHip, L_Hip, hip.L.
    """
    name, opposite = plain(name), plain(opposite)
    options = [name]
    for marks, others in (SIDES, SIDES[::-1]):
        for mark, other in zip(marks, others, strict=True):
            for start in [match.start() for match in re.finditer(f"(?={mark})", name)]:
                before, after = name[:start], name[start + len(mark) :]
                if before + other + after == opposite:
                    options += [mark + before + after for mark in marks] + [
                        before + after + mark for mark in marks
                    ]
    return list(dict.fromkeys(options))


def spelled(pairs: Mapping[str, str]) -> dict[str, str]:
    """Returns a mapping from each spelling of a name (see `spellings`) to the name.

    If two names share a spelling, the spelling refers to the name that is spelled exactly that way.

    Args:
        pairs: for each name, its counterpart on the other side, or the name itself.
    """
    variants = {name: spellings(name, opposite) for name, opposite in pairs.items()}
    names: dict[str, str] = {}
    for name, options in variants.items():
        names.setdefault(options[0], name)
    for name, options in variants.items():
        for option in options[1:]:
            names.setdefault(option, name)
    return names


def best_match(names: Sequence[str], skeletons: Mapping[str, Mapping[str, str]]) -> Match:
    """Returns the skeleton that best matches a list of joint names.

    Skeletons without missing joints are preferred, then skeletons with more matching names, then
    skeletons listed earlier. If several prefixes match equally well, the match is ambiguous.

    Args:
        names: joint names in a file. At least one name is required.
        skeletons: for each skeleton, a mapping from spellings of a joint to the joint's name in the
            skeleton. The first spelling is preferred.
    """
    best: list[Match] = []
    score = (False, -1)
    for prefix in _prefixes(names):
        by_name: dict[str, list[int]] = {}
        for number, name in enumerate(names):
            by_name.setdefault(plain(name.removeprefix(prefix)), []).append(number)
        for key, skeleton in skeletons.items():
            match = _match(key, skeleton, by_name)
            rank = (not match.missing, len(match.numbers))
            if rank > score:
                best, score = [match], rank
            elif rank == score and match.skeleton == best[0].skeleton:
                best.append(match)
    chosen = best[0]
    for other in best[1:]:
        for name, numbers in other.numbers.items():
            chosen.numbers[name] = sorted({*chosen.numbers.get(name, []), *numbers})
    return chosen


def _match(key: str, skeleton: Mapping[str, str], by_name: Mapping[str, list[int]]) -> Match:
    numbers: dict[str, list[int]] = {}
    for spelling, name in skeleton.items():
        if spelling in by_name:
            numbers.setdefault(name, by_name[spelling])
    return Match(
        key,
        dict(numbers),
        [name for name in dict.fromkeys(skeleton.values()) if name not in numbers],
    )


def _prefixes(names: Sequence[str]) -> list[str]:
    """Returns "", and the prefixes (up to a separator) that at least `SHARED` names share.

    The most frequent prefix comes first.
    """
    counts: Counter[str] = Counter()
    for name in set(names):
        counts.update(
            {name[: end.end()] for end in re.finditer(r"[\W_]+", name) if end.end() < len(name)}
        )
        counts.update(match[0] for match in [JOINED.match(name)] if match)
    shared = [prefix for prefix, count in counts.most_common() if count >= SHARED]
    return ["", *shared[:PREFIXES]]
