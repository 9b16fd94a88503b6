"""The CMU motion capture database, with captions from HumanML3D, KIT-ML or the user.

The motions from http://mocap.cs.cmu.edu are read from ASF/AMC files, or from BVH files that were
converted from them. The motions are free for all uses. Captions: Guo et al., CVPR 2022 (HumanML3D),
and Plappert et al., Big Data 2016 (KIT-ML). `docs/cmu.md` lists the required downloads, and
describes how this data differs from HumanML3D and KIT-ML.
"""

import re
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path, PurePosixPath
from typing import Any, Literal, NamedTuple

import numpy as np
import torch

from flame_mdm.data import SPLITS, Clip, MotionSource, Split, archives, hashed_split, required
from flame_mdm.data.captions import TABLE, drawn_splits, known_split, table_rows
from flame_mdm.data.humanml3d import FPS, HumanML3D, IndexedClip, read_index
from flame_mdm.data.parallel import in_order
from flame_mdm.data.t2m import MAX_LENGTH, Cut, Description, cuts
from flame_mdm.errors import UserError
from flame_mdm.formats.bvh import Bvh
from flame_mdm.formats.layouts import LAYOUTS, leg_length
from flame_mdm.formats.motion import amass_parameters
from flame_mdm.formats.poses import solve
from flame_mdm.formats.readers import read_recording
from flame_mdm.formats.recordings import is_at_60
from flame_mdm.representations.skeleton import SMPL22
from flame_mdm.representations.smpl import ADULT
from flame_mdm.safe_io import naming, read_json, read_package_yaml

FACTS: dict[str, Any] = read_package_yaml(Path(__file__).with_suffix(".yaml"))
FILE = re.compile(r"(\d{2,3}_\d{2,3})\.(amc|bvh)", re.IGNORECASE)
# Extensions of the files that are unpacked from an archive
SUFFIXES = (
    ".amc",
    ".asf",
    ".bvh",
    ".csv",
    ".json",
    ".txt",
    ".yaml",
    ".zip",
)
# Frame rates of the recordings, the most frequent rate first
RATES = (120.0, 60.0)
# Tolerance of durations in seconds: one frame at 20 fps
SLACK = 0.05
# Minimum number of feature rows of a clip, as in HumanML3D
SHORTEST = 40
# Number of frames after the T-pose that Daz-friendly files blend with it
BLENDED = 3
# Columns of the user's caption table
COLUMNS = (
    "id",
    "begin",
    "end",
    "text",
    "action",
    "split",
    "source",
)
# Number of frames assumed for a recording of unknown length. Any number above `SHORTEST` works.
UNKNOWN = 1000
# The arguments `seconds`, `last` and `is_sixty` of `decide_rate`
Evidence = tuple[float | None, int | None, bool]
MAP = {**LAYOUTS["CMU ASF"].map, "pelvis": "pelvis", "neck": "upperneck", "head": "face"}
_HIP, _KNEE, _ANKLE, _HEAD = (
    ADULT[SMPL22.joints.index(n)] for n in ("left_hip", "left_knee", "left_ankle", "head")
)
ADULT_LEG = float(np.linalg.norm(_KNEE) + np.linalg.norm(_ANKLE))
GET_IT = (
    "clone https://github.com/una-dinosauria/cmu-mocap or unpack ASF/AMC files from http://mocap.cs.cmu.edu, clone "
    "https://github.com/EricGuo5513/HumanML3D, and set SOURCE=/path/to/the/motions "
    "data.source.captions=/path/to/HumanML3D"
)


class Item(NamedTuple):
    """Captions for a recording, or for the part from frame `start` to frame `end` at 20 fps.

    `action` is the label of a part in `captions.csv`. `is_own` is True for such parts, and False
    for captions from HumanML3D and KIT-ML.
    """

    id: str
    split: Split
    source: str
    descriptions: list[Description]
    start: int = 0
    end: int | None = None
    mirrored: bool = False
    action: str | None = None
    is_own: bool = False

    def cuts(self, frames: int) -> list[Cut]:
        """Returns the clips to cut from this part, which has `frames` rows of features."""
        if not self.is_own:
            return cuts(self.id, frames, self.descriptions, SHORTEST)
        return [Cut(self.id, 0, frames, self.descriptions)] if frames >= SHORTEST else []


class CMU(MotionSource):
    """Captioned recordings of the CMU database, converted to SMPL's 22 joints.

    The clips are HumanML3D's clips, recordings with KIT-ML's captions, or motions with the user's
    captions. HumanML3D's clips keep their names, splits and mirrored copies. A recording with
    KIT-ML's captions is in the same split as the HumanML3D clips that are cut from it. If these
    clips are in several splits, the test split has priority, followed by val. If HumanML3D contains
    no clip of the recording, the subject determines the split. If there is a table `captions.csv`,
    only its captions are used, and each recording or part of a recording in the table becomes one
    clip.

    Args:
        path: folder with recordings such as 02_01.bvh, or 02_01.amc and 02.asf, in any
            subfolders; or an archive of such a folder.
        captions: clone of HumanML3D's repository; a folder with texts, splits and index; or a
            folder with `captions.csv`. Default: `path`. KIT-ML's captions for AMASS (kitml*.json)
            are used if `path` or `captions` contains them.
        motion: "joints" for joint positions, or "smpl" for SMPL's rotations, which are computed
            from the joint positions.
    """

    name = "cmu"
    license = "CMU"
    version = 2  # in version 1, a nod changed the length of the bone from neck to head

    def __init__(
        self,
        path: str,
        captions: str | None = None,
        motion: Literal["joints", "smpl"] = "joints",
        exclude: Sequence[str] = (),
        workers: int = 0,
    ):
        self.archive, self._captions = Path(path), captions
        self.motion, self.exclude, self.workers = motion, tuple(exclude), workers
        self.options = {"motion": motion, "exclude": list(exclude)}
        self._errors, self._counts = list[str](), Counter[str]()

    @cached_property
    def path(self) -> Path:
        """Folder with the recordings. An archive is unpacked into a temporary folder."""
        return archives.as_folder(self.archive, self, lambda name: name.lower().endswith(SUFFIXES))

    @property
    def captions(self) -> Path:
        """Folder with the captions."""
        return self.path if self._captions is None else Path(self._captions)

    @cached_property
    def files(self) -> dict[str, list[Path]]:
        """Files of each recording, with the best file first.

        Recordings that are known to be bad are left out.
        """
        files: defaultdict[str, list[Path]] = defaultdict(list)
        for path in sorted(self.path.rglob("*")):
            if match := FILE.fullmatch(path.name):
                files[match[1]].append(path)
        if not files:
            raise FileNotFoundError(
                f"{self.path}: contains no recording such as 02_01.bvh or 02_01.amc; {GET_IT}"
            )
        kept = self.not_excluded(files, self.path)
        good = {
            name: sorted(kept[name], key=_rank) for name in sorted(kept) if not _is_in("bad", name)
        }
        self.leave_out("recordings known to be bad", len(kept) - len(good))
        return good

    @cached_property
    def table(self) -> Path | None:
        """The user's caption table, or None if there is no table."""
        required(self.captions, f"it is the folder with the captions: {GET_IT}")
        path = self.captions / TABLE
        return path if path.exists() else None

    @cached_property
    def humanml3d(
        self,
    ) -> tuple[list[IndexedClip], dict[str, list[Description]], Mapping[str, Split]]:
        """HumanML3D's clips from CMU recordings, with their captions and splits, keyed by name.

        All three are empty if the user provides captions.
        """
        if self.table:
            return [], {}, {}
        required(self.captions, f"it is the folder with the captions: {GET_IT}")
        if files := sorted(self.captions.glob("humanml3d_test_captions*.json")):
            rows = read_index(self.captions / "humanml3d_index_cmu.csv")
            texts = _test_captions(files[0])
            splits: Mapping[str, Split] = dict.fromkeys(texts, SPLITS[2])
        else:
            inner = self.captions / "HumanML3D"
            source = HumanML3D(str(inner if inner.is_dir() else self.captions))
            rows, texts, splits = source.rows, source.texts, source.names
        wrong = FACTS["wrong_captions"]
        return (
            [row for row in rows if row.key.startswith("CMU/") and row.name not in wrong],
            texts,
            splits,
        )

    @cached_property
    def kit(self) -> list[tuple[str, str, str, float]]:
        """KIT-ML's captions for CMU recordings, as tuples of id, recording, text and seconds.

        The list is empty if the file with these captions is missing.
        """
        if self.table:
            return []
        files = [
            file
            for folder in (self.captions, self.path)
            for file in sorted(folder.glob("kitml*.json"))
        ]
        if not files:
            return []
        with naming(
            files[0],
            AttributeError,
            KeyError,
            TypeError,
            ValueError,
            prefix="not KIT-ML's captions for AMASS: ",
        ):
            return [
                (
                    f"kit{number}",
                    _recording(entry["path"]),
                    str(text["text"]),
                    float(entry["duration"]),
                )
                for number, entry in read_json(files[0]).items()
                if entry["path"].startswith("CMU/")
                for text in entry["annotations"]
            ]

    @cached_property
    def items(self) -> dict[str, list[Item]]:
        """Parts to cut from each existing recording that has captions."""
        files, (rows, texts, splits) = self.files, self.humanml3d
        items: defaultdict[str, list[Item]] = defaultdict(list)
        cut_from: defaultdict[str, set[Split]] = defaultdict(set)
        for row in rows:
            trial = _recording(row.key)
            cut_from[trial].add(splits.get(row.name, "train"))
            names = [
                name for name in (row.name, f"M{row.name}") if name in splits and texts.get(name)
            ]
            if trial not in files:
                self.leave_out("HumanML3D clips whose recording is missing")
            elif not names:
                self.leave_out("HumanML3D clips without captions")
            else:
                items[trial] += [
                    Item(n, splits[n], row.name, texts[n], row.start, row.end, n[0] == "M")
                    for n in names
                ]
        for id_, trial, text, _ in self.kit:
            if trial in files:
                by_subject = hashed_split(f"CMU subject {trial.partition('_')[0]}", val=5, test=10)
                of_clips: list[Split] = [split for split in SPLITS if split in cut_from[trial]] or [
                    by_subject
                ]
                items[trial].append(
                    Item(id_, of_clips[-1], f"recording {trial}", [Description(text, [])])
                )
        if self.table:
            parts = _parts(self.table)
            present = {name: part for name, part in parts.items() if part.trial in files}
            self.leave_out(
                f"parts in {TABLE} whose recording is missing", len(parts) - len(present)
            )
            items.update(_own_items(present))
        captioned = {trial: items[trial] for trial in files if items[trial]}
        self.leave_out("recordings without a caption", len(files) - len(captioned))
        if not captioned:
            raise UserError(
                f"{self.captions}: no captions for the recordings in {self.path}; {GET_IT}"
            )
        return captioned

    def count(self) -> int:
        """Returns the number of clips.

        Recordings are not read, because the captions determine the lengths of the clips.
        """
        items = [item for items in self.items.values() for item in items]
        ends = {id_: round(seconds * FPS) for id_, _, _, seconds in self.kit}
        frames = [(item.end or ends.get(item.id, UNKNOWN)) - item.start - 1 for item in items]
        return sum(len(item.cuts(count)) for item, count in zip(items, frames, strict=True))

    def clips(self, fps: float) -> Iterator[Clip]:
        """Yields the clips of all readable recordings.

        `findings` lists the recordings that cannot be read.
        """
        self.check_fps(fps, FPS)
        labels = {item.action for items in self.items.values() for item in items}
        self.actions = tuple(sorted(label for label in labels if label is not None))
        last = {
            _recording(row.key): row.end
            for row in sorted(self.humanml3d[0], key=lambda row: row.end)
        }
        seconds = {trial: length for _, trial, _, length in self.kit}
        evidence = {
            trial: (seconds.get(trial), last.get(trial), is_at_60(trial)) for trial in self.items
        }
        tasks = [(self.files[trial], evidence[trial], items) for trial, items in self.items.items()]
        for trial, motions in zip(
            self.items, in_order(partial(_read, self.motion), tasks, self.workers), strict=True
        ):
            if isinstance(motions, str):
                self._errors.append(motions)
                self.leave_out("recordings that cannot be read")
                continue
            for item, motion in zip(self.items[trial], motions, strict=True):
                if not (kept := item.cuts(len(motion) - 1)):
                    longest = "" if item.is_own else f" or with {MAX_LENGTH} or more"
                    self.leave_out(f"motions shorter than {SHORTEST} frames{longest}")
                for cut in kept:
                    if item.end and not item.mirrored and not item.is_own:
                        self._counts["clips of HumanML3D"] += cut.id == item.id
                        self._counts["captions of HumanML3D"] += len(cut.descriptions)
                    clip = cut.clip(motion, item.split, item.source, recording=trial)
                    action = None if item.action is None else self.actions.index(item.action)
                    yield replace(clip, action=action)
        if len(self._errors) == len(tasks):
            raise UserError(
                f"{self.path}: none of the recordings can be read. The first error is: {self._errors[0]}"
            )

    def counts(self) -> Mapping[str, float]:
        """Returns the number of HumanML3D clips and captions that were read."""
        return self._counts

    def findings(self) -> list[str]:
        """Returns one line per recording that cannot be read."""
        return [f"left out: {error}" for error in self._errors]


@dataclass
class _Part:
    """A part of a recording, as listed in a caption table: frames `start` to `end` at 20 fps."""

    name: str
    trial: str
    start: int
    end: int | None
    split: Split | None
    source: str | None
    action: str | None
    texts: list[str] = field(default_factory=list)


def _parts(table: Path) -> dict[str, _Part]:
    """Returns the parts of recordings that a table lists, keyed by name.

    Rows for the same part contain captions for the same clip.
    """
    parts: dict[str, _Part] = {}
    for where, cells in table_rows(table, COLUMNS):
        with naming(where):
            part = _part_in_table(cells)
            before = parts.setdefault(part.name, part)
            if replace(before, texts=[]) != replace(part, texts=[]):
                raise UserError(f"{part.name} has conflicting values for split, source or action")
            before.texts += [text] if (text := cells.get("text")) else []
    for kind in ("texts", "action"):
        bare = [name for name, part in parts.items() if not getattr(part, kind)]
        if 0 < len(bare) < len(parts):
            raise UserError(
                f"{table}: {len(bare)} of {len(parts)} parts have no {kind.removesuffix('s')} (for example, "
                f"{bare[0]}). Add one to each, or leave these parts out"
            )
    return parts


def _own_items(parts: Mapping[str, _Part]) -> dict[str, list[Item]]:
    """Returns the parts of each recording.

    Splits that the table does not specify are drawn by source or, for parts without a source, by
    subject.
    """
    sources = {
        name: part.source or f"CMU subject {part.trial.partition('_')[0]}"
        for name, part in parts.items()
    }
    splits = drawn_splits(sources, {name: part.split for name, part in parts.items()})

    items: defaultdict[str, list[Item]] = defaultdict(list)
    for name, part in parts.items():
        source = part.source or f"recording {part.trial}"
        descriptions = [Description(text, []) for text in part.texts]
        item = Item(
            name,
            splits[name],
            source,
            descriptions,
            part.start,
            part.end,
            action=part.action,
            is_own=True,
        )
        items[part.trial].append(item)
    return items


def _part_in_table(cells: Mapping[str, str]) -> _Part:
    """Returns the part of a recording that a row describes, without its captions."""
    trial, begin, end = cells["id"], cells.get("begin", ""), cells.get("end", "")
    if not re.fullmatch(r"\d{2,3}_\d{2,3}", trial):
        raise UserError(f"id {trial!r} is not the name of a recording, such as 02_01")
    first, last = 0, None
    with naming(
        f"begin {begin!r}, end {end!r}",
        ValueError,
        OverflowError,
        prefix="not times in seconds: ",
    ):
        first = round(float(begin) * FPS) if begin else 0
        last = round(float(end) * FPS) if end else None
    if first < 0 or (last is not None and last <= first):
        raise UserError(
            f"begin {begin!r}, end {end!r}: expected times in seconds, with 0 <= begin < end"
        )
    name = f"{trial}@{begin or 0}-{end or 'end'}" if begin or end else trial
    split = known_split(cells["split"]) if cells.get("split") else None
    return _Part(
        name, trial, first, last, split, cells.get("source") or None, cells.get("action") or None
    )


def _is_in(fact: str, trial: str) -> bool:
    """Returns whether a list in `cmu.yaml` contains a recording or its subject."""
    return not {trial, trial.partition("_")[0]}.isdisjoint(FACTS[fact])


def _rank(path: Path) -> int:
    """Returns the rank of a file: 0 = original, 1 = converted, 2 = Daz-friendly conversion.

    Daz-friendly conversions come last, because their legs often jump.
    """
    if path.suffix.lower() == ".amc":
        return 0
    return 2 if "daz" in str(path).lower() else 1


def _recording(key: str) -> str:
    return PurePosixPath(key).stem.removesuffix("_poses")


def _test_captions(path: Path) -> dict[str, list[Description]]:
    """Reads a JSON list of test captions, and returns the captions of each motion.

    The `segment` field states the start and end of the described part in seconds.
    """
    texts: defaultdict[str, list[Description]] = defaultdict(list)
    with naming(path, KeyError, TypeError, ValueError, prefix="not a list of HumanML3D captions: "):
        for entry in read_json(path):
            begin, end = map(float, entry["segment"] or (0, 0))
            name = f"M{entry['base']}" if entry["mirrored"] else entry["base"]
            texts[name] += [
                Description(str(caption), [], begin, end) for caption in entry["captions"]
            ]
    return texts


def decide_rate(
    frames: int, header: float | None, seconds: float | None, last: int | None, is_sixty: bool
) -> float:
    """Returns the frame rate of a recording with `frames` frames.

    KIT-ML's `seconds` have the highest priority, followed by HumanML3D's `last` frame at 20 fps and
    then by CMU's list of recordings at 60 fps (`is_sixty`). The `header` of the file has the lowest
    priority, because converted files specify 120 fps for nearly all recordings.
    """
    rates = RATES if header in (None, *RATES) else (*RATES, header)
    if fitting := [rate for rate in rates if seconds and abs(frames / rate - seconds) < SLACK]:
        return fitting[0]
    if (
        last
        and header != RATES[1]
        and frames / RATES[0] + SLACK < last / FPS <= frames / RATES[1] + SLACK
    ):
        return RATES[1]
    return RATES[1] if is_sixty else header or RATES[0]


def standardize(tree: Bvh) -> tuple[Bvh, dict[str, Any]]:
    """Returns a recording with the bones of CMU's own files, together with its `Layout` fields.

    Files of the MotionBuilder-friendly and Daz-friendly conversions begin with a T-pose, which is
    removed. The joints `pelvis` and `face` are added at the positions of SMPL's pelvis and head. In
    the Daz figure, `upperneck` is also added. Recordings with other skeletons are returned
    unchanged and without fields.
    """
    is_original, unit, blended = "lfemur" in tree.joints, LAYOUTS["CMU ASF"].unit, 0
    # The MotionBuilder-friendly conversion lacks one bone of the trunk and one bone of each hand.
    # Each of these bones is restored as a fraction of the neighboring bone with which it was
    # merged.
    if "LHipJoint" in tree.joints:
        offsets, at = tree.offsets.copy(), tree.joints.index
        for child, (share, bone) in FACTS["lost"].items():
            if child in tree.joints and not offsets[at(child)].any():
                offsets[at(child)] = share * offsets[at(bone)]
        tree = replace(
            tree,
            offsets=offsets,
            joints=tuple(FACTS["motionbuilder"].get(n, n) for n in tree.joints),
        )
    # The Daz-friendly conversion animates a different figure. Its rotations are kept, and its bones
    # are replaced by the bones of a person.
    elif "lButtock" in tree.joints:
        tree, unit, blended = _added(tree, upperback=("abdomen", [0, 0, 0])), 0.01, BLENDED
        rows = [
            FACTS["daz"].get(name, [name, *offset])
            for name, offset in zip(tree.joints, tree.offsets, strict=True)
        ]
        tree = replace(
            tree,
            joints=tuple(row[0] for row in rows),
            offsets=np.array([row[1:] for row in rows], float),
        )
    if "lfemur" not in tree.joints:
        return tree, {}
    # A first frame without rotation is the T-pose. In Daz-friendly files, the next few frames
    # blend it with the motion. These frames take the pose of the first frame after them.
    if not (is_original or tree.frames[0, 3:6].any()) and len(tree.frames) > 1 + blended:
        frames = tree.frames[1:].copy()
        frames[:blended, 6:] = frames[blended, 6:]
        tree = replace(tree, frames=frames)

    # SMPL's pelvis is above the midpoint of the hips. The distance is scaled with the legs.
    bone = dict(zip(tree.joints, tree.offsets, strict=True))
    scale = float(np.linalg.norm(bone["ltibia"]) + np.linalg.norm(bone["lfoot"])) / ADULT_LEG
    pelvis = (bone["lfemur"] + bone["rfemur"]) / 2 - [0, scale * _HIP[1], 0]
    # As in SMPL, the head joint follows the neck but not the rotations of the head, so that its
    # bone keeps its length.
    above = tree.parents[tree.joints.index("head")]
    face = bone["head"] + [0, 0, scale * _HEAD[2]]
    tree = _added(tree, pelvis=("root", pelvis), face=(tree.joints[above], face))
    # The Daz figure has a single bone from the lower neck to the head. It is divided in the middle.
    if "upperneck" not in tree.joints:
        tree = _added(tree, upperneck=(tree.joints[above], bone["head"] / 2))
    return tree, {"map": MAP, "unit": unit}


def _added(tree: Bvh, **joints: tuple[str, Any]) -> Bvh:
    """Adds joints to a tree.

    The keyword arguments map the name of each new joint to its parent and its offset (3,).
    """
    return replace(
        tree,
        joints=(*tree.joints, *joints),
        parents=(*tree.parents, *(tree.joints.index(parent) for parent, _ in joints.values())),
        offsets=np.concatenate([tree.offsets, [offset for _, offset in joints.values()]]),
        channels=tree.channels + ((),) * len(joints),
    )


def _read(kind: str, task: tuple[list[Path], Evidence, list[Item]]) -> list[np.ndarray] | str:
    """Returns the motions in the first readable file, or the first error if no file is readable."""
    files, evidence, items = task
    errors = []
    for file in files:
        is_original = _rank(file) == 0
        standard = partial(_standardized, is_original, evidence)
        try:
            recording = read_recording(
                file, FPS, fps=RATES[0] if is_original else None, standard=standard
            )
            if recording.doubts.jump:
                raise UserError(f"{file}: {recording.doubts.jump}")
        except (UserError, OSError) as error:
            errors.append(str(error))
        else:
            joints = recording.motion.joints
            return [_part(joints[item.start : item.end], item.mirrored, kind) for item in items]
    return errors[0]


def _standardized(is_original: bool, evidence: Evidence, tree: Bvh) -> tuple[Bvh, dict[str, Any]]:
    """Applies `standardize` to a recording and sets its frame rate."""
    tree, fields = standardize(tree)
    rate = decide_rate(len(tree.frames), None if is_original else tree.fps, *evidence)
    return replace(tree, fps=rate), fields


def _part(joints: np.ndarray, mirrored: bool, kind: str) -> np.ndarray:
    """Returns a part as joint positions or as an SMPL motion.

    An SMPL motion (F, 75) consists of the translation and the SMPL rotations of the adult body, in
    AMASS's coordinates.
    """
    part = SMPL22.mirror(torch.from_numpy(joints)) if mirrored else torch.from_numpy(joints)
    if kind == "joints" or len(joints) <= SHORTEST:
        return part.numpy()
    floor = part.new_tensor([0, float(part[..., 1].min()), 0])
    turns, translation = amass_parameters(
        solve((part - floor) * (ADULT_LEG / leg_length(joints)), FPS)
    )
    return np.concatenate([translation, np.pad(turns, ((0, 0), (0, 6)))], 1).astype(np.float32)
