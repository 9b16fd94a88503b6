"""Errors of generated motions against the real motion of the same text, or the motion that was edited."""

from collections.abc import Iterator, Mapping, Sequence

import torch
from torch import Tensor

from evaluators.metrics.samples import SampleMetric, real_frames
from flame_mdm.errors import UserError
from flame_mdm.representations import rotation
from flame_mdm.representations.rifke import Rifke, upsample

PARTS = ("root", "trajectory", "mean_local", "mean_global")

RIFKE = Rifke()


def temos_parts(joints: Tensor) -> dict[str, Tensor]:
    """Returns root (F, 3), trajectory (F, 2), local (F, 20, 3) and global (F, 21, 3) positions, as compared by TEMOS.

    The motion (F, 21, 3), in KIT units, is placed on the floor, with its first root at x = z = 0 and its first heading
    along +z. Local positions are those of all joints except the root, relative to the body in each frame: root at
    x = z = 0, heading along +z, y above the floor. Floor and heading are those of `Rifke`, with their peculiarities.
    """
    ground = joints[:, :1] * joints.new_tensor([1.0, 0.0, 1.0])
    floor = joints.new_tensor([0.0, 1.0, 0.0]) * RIFKE.floor(joints)
    heading = RIFKE.heading(joints)[:, None]
    placed = rotation.rotate_y(joints - floor - ground[:1], -heading[:1])
    return {
        "root": placed[:, 0],
        "trajectory": placed[:, 0, [0, 2]],
        "mean_local": rotation.rotate_y(joints - floor - ground, -heading)[:, 1:],
        "mean_global": placed,
    }


def flame_parts(joints: Tensor, root: Tensor, parents: Sequence[int]) -> dict[str, Tensor]:
    """Returns root (F, 3), trajectory (F, 2), bones (F, J - 1, 3) and joints (F, J, 3), as compared by FLAME's code."""
    bones = joints[:, 1:] - joints[:, list(parents[1:])]
    return {"root": root, "trajectory": root[:, [0, 2]], "mean_local": bones, "mean_global": joints}


class PositionErrors(SampleMetric):
    """APE and AVE by part. Each clip adds a sum of position errors, its number of frames, and its variance errors.

    Args:
        samples: motions per text. If there are several, the best and the worst are used, as in TEMOS: those with the
            smallest and the largest APE of the root, which also provide all other values.
        upsampling: frames of a recording per frame of a motion. Above 1, motions are interpolated and compared with
            the recordings.
    """

    higher_is_better = False
    states = ("groups", "position", "variance", "frames")
    equal_clips = False  # whether position errors are averaged over clips instead of frames

    def __init__(self, samples: int = 1, upsampling: int = 1):
        super().__init__()
        self.samples, self.upsampling = samples, upsampling
        self.ranked = {"best_": False, "worst_": True} if samples > 1 else {"": False}
        errors = [f"{error}_{part}" for error in ("ape", "ave") for part in PARTS]
        self.names = [f"{prefix}{error}" for prefix in self.ranked for error in errors]

    def update(
        self,
        joints: Tensor,
        mask: Tensor,
        real_joints: Tensor,
        real_mask: Tensor,
        keys: Tensor,
        groups: Tensor | None = None,
        references: Sequence[Tensor] | None = None,
    ) -> None:
        """Compares pairs of motions up to the end of the shorter one; upsampling needs `references`.

        Raises:
            UserError: If a motion has fewer than two frames, or a needed reference is missing.
        """
        name = type(self).__name__
        generated, real_motions = real_frames(name, joints, mask), real_frames(name, real_joints, real_mask)
        if self.upsampling > 1:
            if references is None:
                raise UserError(
                    f"{name}: the store has no recordings at their own frame rate. Prepare the data set again with "
                    "force=true"
                )
            generated, real_motions = [upsample(motion, self.upsampling) for motion in generated], list(references)
        position, variance, frames = [], [], []
        for motion, real in zip(generated, real_motions, strict=True):
            a, b = self.parts(motion.double()), self.parts(real.double())
            length = min(len(a["root"]), len(b["root"]))
            self.need(length, 2, "frames of a motion")
            a, b = ({part: values[:length] for part, values in x.items()} for x in (a, b))
            for errors, of_clip in zip((position, variance), self.errors(a, b), strict=True):
                errors.append(of_clip)
            frames.append([length])
        if frames:
            self.keep(
                keys=keys,
                groups=keys if groups is None or self.samples == 1 else groups,
                position=torch.stack(position),
                variance=torch.stack(variance),
                frames=position[0].new_tensor(frames),
            )

    def value(self, groups: Tensor, position: Tensor, variance: Tensor, frames: Tensor) -> dict[str, float | None]:
        """Returns "ape" and "ave" of each of `PARTS`, such as `ape_root`; of several per text, `best_ape_root` ..."""
        texts = self.by_group(groups, self.samples)
        root = (position[:, 0] / frames[:, 0])[texts]
        values: list[float] = []
        for descending in self.ranked.values():
            first = root.argsort(dim=1, descending=descending, stable=True)[:, :1]
            chosen = texts.gather(1, first)[:, 0]
            values += self.average(position[chosen], frames[chosen]).tolist() + variance[chosen].mean(0).tolist()
        return dict(zip(self.names, values, strict=True))

    def parts(self, joints: Tensor) -> dict[str, Tensor]:
        """Returns the compared quantities of a whole motion (F, J, 3), by the names of `PARTS`."""
        raise NotImplementedError

    def errors(self, a: Mapping[str, Tensor], b: Mapping[str, Tensor]) -> tuple[Tensor, Tensor]:
        """Returns the errors of each part of a clip, (4,): of positions, summed over frames, and of variances."""
        raise NotImplementedError

    def average(self, position: Tensor, frames: Tensor) -> Tensor:
        """Averages the position errors (4,) of all clips from their sums (N, 4) and numbers of frames (N, 1)."""
        return (position / frames).mean(0) if self.equal_clips else position.sum(0) / frames.sum(0)


class TemosPositionErrors(PositionErrors):
    """APE and AVE of TEMOS (Petrovich et al. 2022), used by FLAME on KIT (eq. 16 to 18, Table 2).

    APE is the distance of `temos_parts`, averaged over joints, and over all frames of all clips. AVE is the distance of
    the variances over time (n - 1 in the denominator) of each coordinate, averaged over joints, then over clips. Both
    are in units of 1000 KIT units, which the tables call meters and which are 1.56 m. TEMOS compares at 100 frames per
    second: `upsampling=8`.

    Args:
        units_per_metre: KIT units per meter of `joints`, as in the KIT representations.
    """

    def __init__(self, units_per_metre: float = 640.0, samples: int = 1, upsampling: int = 1):
        super().__init__(samples, upsampling)
        self.units_per_metre = units_per_metre

    def parts(self, joints: Tensor) -> dict[str, Tensor]:
        if joints.shape[1] != 21:
            raise UserError(f"TemosPositionErrors: {joints.shape[1]} joints, but defined only for KIT's 21 (MMM)")
        return {part: values / 1000 for part, values in temos_parts(joints * self.units_per_metre).items()}

    def errors(self, a: Mapping[str, Tensor], b: Mapping[str, Tensor]) -> tuple[Tensor, Tensor]:
        distance = [(a[part] - b[part]).norm(dim=-1) for part in PARTS]
        variance = [(a[part].var(0) - b[part].var(0)).norm(dim=-1).mean() for part in PARTS]
        return torch.stack([d.sum() if d.ndim == 1 else d.mean(1).sum() for d in distance]), torch.stack(variance)


class FlamePositionErrors(PositionErrors):
    """APE and AVE as in FLAME's code, which its tables do not use. In meters and square meters.

    Compares `flame_parts`. The error of the trajectory is the sum of the distances along its two axes; the local error
    is that of bones. Variances of global positions are averaged over joints before they are compared. Each clip has the
    same weight. FLAME's joints lack the orientation of the root and start from its translation; here, `joints` are
    compared unchanged, and the first one is the root.

    Args:
        parents: parent of each joint of the skeleton, -1 for the root.
    """

    equal_clips = True

    def __init__(self, parents: Sequence[int], samples: int = 1):
        super().__init__(samples)
        self.parents = tuple(parents)

    def parts(self, joints: Tensor) -> dict[str, Tensor]:
        return flame_parts(joints, joints[:, 0], self.parents)

    def errors(self, a: Mapping[str, Tensor], b: Mapping[str, Tensor]) -> tuple[Tensor, Tensor]:
        along_axes = (a["trajectory"] - b["trajectory"]).abs().sum(-1)
        root, local, all_joints = ((a[p] - b[p]).norm(dim=-1) for p in ("root", "mean_local", "mean_global"))
        position = torch.stack([root.sum(), along_axes.sum(), local.mean(1).sum(), all_joints.mean(1).sum()])
        root, trajectory, local, all_joints = (a[part].var(0) - b[part].var(0) for part in PARTS)
        variance = [root.norm(), trajectory.norm(), local.norm(dim=-1).mean(), all_joints.mean(0).norm()]
        return position, torch.stack(variance)


class DisplacementErrors(SampleMetric):
    """ADE and FDE: mean distance of the joints in all predicted frames, and in the last of them, in meters.

    This is the usual definition in motion prediction (Yuan and Kitani 2020): the average over joints and frames of a
    clip, then over clips. Frames and joints that an edit kept are ignored. If lengths differ, motions are compared up
    to the end of the shorter one. MFM (Table 3) gives no formula, code or unit for its numbers, which are too large for
    meters: they are not comparable.
    """

    higher_is_better = False
    states = ("errors",)
    names = ("ade", "fde")

    def update(
        self,
        joints: Tensor,
        mask: Tensor,
        real_joints: Tensor,
        real_mask: Tensor,
        keys: Tensor,
        kept: Tensor | None = None,
    ) -> None:
        """Raises `UserError` if nothing of a motion was generated; without `kept`, all of it was."""
        errors = []
        for distance, old in _distances(type(self).__name__, joints, mask, real_joints, real_mask, kept):
            new = ~old
            if not new.any():
                raise UserError("DisplacementErrors: a motion has no generated frame to compare")
            last = int(new.any(1).nonzero()[-1])
            errors.append(torch.stack([distance[new].mean(), distance[last][new[last]].mean()]))
        if errors:
            self.keep(keys=keys, errors=torch.stack(errors))

    def value(self, errors: Tensor) -> dict[str, float | None]:
        return dict(zip(self.names, errors.mean(0).tolist(), strict=True))


class KeptDrift(SampleMetric):
    """Distance in the world, in meters, by which the kept part of an edit has moved. A metric of this project.

    With features relative to the root, an edit can keep steps and poses exactly, and still move a kept ending to where
    the new part before it leads.
    """

    higher_is_better = False
    states = ("drift",)
    names = ("mean", "largest")

    def update(
        self, joints: Tensor, mask: Tensor, real_joints: Tensor, real_mask: Tensor, keys: Tensor, kept: Tensor
    ) -> None:
        pairs = list(_distances(type(self).__name__, joints, mask, real_joints, real_mask, kept))
        edited = [number for number, (_, old) in enumerate(pairs) if old.any()]
        if edited:
            kept_distances = (pairs[number][0][pairs[number][1]] for number in edited)
            drift = torch.stack([torch.stack([distance.mean(), distance.max()]) for distance in kept_distances])
            self.keep(keys=keys[edited], drift=drift)

    def value(self, drift: Tensor) -> dict[str, float | None]:
        """Returns `mean`, over the kept joints and frames of a motion and then over motions, and `largest`."""
        return {"mean": drift[:, 0].mean().item(), "largest": drift[:, 1].max().item()}


def _distances(
    name: str, joints: Tensor, mask: Tensor, real_joints: Tensor, real_mask: Tensor, kept: Tensor | None
) -> Iterator[tuple[Tensor, Tensor]]:
    """Yields distances (F, J) in float64 and a mask of the kept joints (F, J), up to the end of the shorter motion."""
    motions = zip(real_frames(name, joints, mask), real_frames(name, real_joints, real_mask), strict=True)
    for number, (motion, real) in enumerate(motions):
        length = min(len(motion), len(real))
        distance = (motion[:length].double() - real[:length].double()).norm(dim=-1)
        old = torch.zeros_like(distance, dtype=torch.bool) if kept is None else kept[number][mask[number]][:length]
        yield distance, old
