"""How far generated motions are from the real motion of the same text, or from the motion they were to continue."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from evaluators.metrics.samples import SampleMetric, by_group, real_frames
from flame_mdm.errors import UserError
from flame_mdm.representations import rotation
from flame_mdm.representations.rifke import Rifke, upsample

PARTS = ("root", "trajectory", "mean_local", "mean_global")

RIFKE = Rifke()


def temos_parts(joints: Tensor) -> dict[str, Tensor]:
    """Root (F, 3), trajectory (F, 2), local (F, 20, 3) and global (F, 21, 3) positions as TEMOS compares them.

    The motion is put on the floor, its first root to x = z = 0, its first heading to +z. Local positions are those of
    all joints but the root seen by the body in each frame: root at x = z = 0, heading +z, y above the floor. Floor and
    heading are those of `Rifke`, with their peculiarities.

    Args:
        joints: (F, 21, 3) MMM's joints in KIT's units, y up; float64.
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
    """Root (F, 3), trajectory (F, 2), bones (F, J - 1, 3) and joints (F, J, 3) as FLAME's code compares them.

    Args:
        joints: (F, J, 3) positions, y up.
        root: (F, 3) translation of the body.
        parents: parent of each joint, -1 for the root.
    """
    bones = joints[:, 1:] - joints[:, list(parents[1:])]
    return {"root": root, "trajectory": root[:, [0, 2]], "mean_local": bones, "mean_global": joints}


class _PositionErrors(SampleMetric):
    """APE and AVE by part; a clip adds a sum of position errors, its frames and its variance errors.

    Args:
        samples: motions a text. Of several, the best and the worst count, as in TEMOS: those with the smallest and the
            largest APE of the root, from which all other values are taken, too.
        upsampling: frames of a recording per frame of a motion. Above 1, motions are interpolated and compared with
            the recordings.
        kwargs: options of `torchmetrics.Metric`.
    """

    higher_is_better = False

    def __init__(self, samples: int = 1, upsampling: int = 1, **kwargs: Any):
        super().__init__(("keys", "groups", "position", "variance", "frames"), **kwargs)
        self.samples, self.upsampling = samples, upsampling

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
        """Adds generated motions (B, F, J, 3) and the real ones in the same order (B, F', J, 3), with their masks.

        Both are compared up to the end of the shorter. `groups` are the keys of the prompts, of several motions each.
        `references` are the real ones (F', J, 3) at the frame rate of their recordings.

        Raises:
            ValueError: a motion has fewer than two frames.
            UserError: no references, although motions are compared at the frame rate of the recordings.
        """
        rows, name = [], type(self).__name__
        generated, real_motions = real_frames(name, joints, mask), real_frames(name, real_joints, real_mask)
        if self.upsampling > 1:
            if references is None:
                raise UserError(
                    f"{name}: the store has no recordings at their own frame rate. Prepare the data set again with "
                    "force=true"
                )
            generated, real_motions = [upsample(motion, self.upsampling) for motion in generated], list(references)
        for motion, real in zip(generated, real_motions, strict=True):
            a, b = self.parts(motion.double()), self.parts(real.double())
            length = min(len(a["root"]), len(b["root"]))
            self.need(length, 2, "frames of a motion")
            a, b = ({part: values[:length] for part, values in x.items()} for x in (a, b))
            rows.append(torch.stack([self.position_errors(a, b), self.variance_errors(a, b)]))
            rows[-1] = torch.cat([rows[-1], rows[-1].new_full((2, 1), length)], 1)
        if rows:
            values = torch.stack(rows)
            self.keep(
                keys=keys,
                groups=keys if groups is None or self.samples == 1 else groups,
                position=values[:, 0, :4],
                variance=values[:, 1, :4],
                frames=values[:, :1, 4],
            )

    def compute(self) -> dict[str, float | None]:
        """`ape_root`, `ape_trajectory`, `ape_mean_local`, `ape_mean_global`, and `ave_` of each.

        Of several motions a text, the same after `best_` and `worst_`.
        """
        rows = self.rows("keys", "groups", "position", "variance", "frames")
        names = [f"{error}_{part}" for error in ("ape", "ave") for part in PARTS]
        several = {"best_": False, "worst_": True} if self.samples > 1 else {"": False}
        if rows is None:
            return {f"{which}{name}": None for which in several for name in names}
        groups, position, variance, frames = rows
        texts = by_group(self, groups, self.samples)
        root = (position[:, 0] / frames[:, 0])[texts]
        found: dict[str, float | None] = {}
        for which, descending in several.items():
            rank = root.argsort(dim=1, descending=descending, stable=True)[:, :1]
            chosen = texts.gather(1, rank)[:, 0]
            values = torch.cat([self.average(position[chosen], frames[chosen]), variance[chosen].mean(0)])
            found |= dict(zip([f"{which}{name}" for name in names], values.tolist(), strict=True))
        return found

    def parts(self, joints: Tensor) -> dict[str, Tensor]:
        """What is compared, from the joints (F, J, 3) of a whole motion, by the names of `PARTS`."""
        raise NotImplementedError

    def position_errors(self, a: Mapping[str, Tensor], b: Mapping[str, Tensor]) -> Tensor:
        """Sum over the frames of a clip of the error of each part, (4,)."""
        raise NotImplementedError

    def variance_errors(self, a: Mapping[str, Tensor], b: Mapping[str, Tensor]) -> Tensor:
        """Error of the variances of a clip in each part, (4,)."""
        raise NotImplementedError

    def average(self, position: Tensor, frames: Tensor) -> Tensor:
        """Position errors (4,) of all clips from their sums (N, 4) and frames (N, 1)."""
        raise NotImplementedError


class TemosPositionErrors(_PositionErrors):
    """APE and AVE of TEMOS (Petrovich et al. 2022), used by FLAME on KIT (eq. 16 to 18, Table 2).

    APE: distance of `temos_parts`, joints averaged; mean over all frames of all clips. AVE: distance of variances over
    time (n - 1 in the denominator) of each coordinate, joints averaged; mean over clips. Both are in units of 1000 KIT
    units, which the tables call metres and which are 1.56 m. TEMOS compares at 100 frames per second:
    `upsampling=8`.

    Args:
        units_per_metre: KIT's units in the metres of `joints`, as the KIT representations have it.
        kwargs: `samples` and `upsampling`, see `_PositionErrors`; options of `torchmetrics.Metric`.
    """

    def __init__(self, units_per_metre: float = 640.0, **kwargs: Any):
        super().__init__(**kwargs)
        self.units_per_metre = units_per_metre

    def parts(self, joints: Tensor) -> dict[str, Tensor]:
        """`temos_parts` in thousands of KIT's units."""
        if joints.shape[1] != 21:
            raise ValueError(f"TemosPositionErrors: {joints.shape[1]} joints, defined for KIT's 21 (MMM) only")
        return {part: values / 1000 for part, values in temos_parts(joints * self.units_per_metre).items()}

    def position_errors(self, a: Mapping[str, Tensor], b: Mapping[str, Tensor]) -> Tensor:
        """Sum over the frames of the distance of each part, joints averaged."""
        distance = [(a[part] - b[part]).norm(dim=-1) for part in PARTS]
        return torch.stack([d.sum() if d.ndim == 1 else d.mean(1).sum() for d in distance])

    def variance_errors(self, a: Mapping[str, Tensor], b: Mapping[str, Tensor]) -> Tensor:
        """Distance of the variances of each part, joints averaged."""
        return torch.stack([(a[part].var(0) - b[part].var(0)).norm(dim=-1).mean() for part in PARTS])

    def average(self, position: Tensor, frames: Tensor) -> Tensor:
        """Each frame counts alike."""
        return position.sum(0) / frames.sum(0)


class FlamePositionErrors(_PositionErrors):
    """APE and AVE as in FLAME's code, which its tables do not use. In metres and square metres.

    Compares `flame_parts`: the trajectory by the sum of the two distances along the axes; local is the error of bones.
    Variances of global positions are averaged over joints before they are compared. Each clip counts alike. FLAME's
    joints lack the orientation of the root and start from its translation; here `joints` are as they are, and their
    first is the root.

    Args:
        parents: parent of each joint, -1 for the root; those of the skeleton.
        kwargs: `samples` motions a text, see `_PositionErrors`; options of `torchmetrics.Metric`.
    """

    def __init__(self, parents: Sequence[int], **kwargs: Any):
        super().__init__(**kwargs)
        self.parents = tuple(parents)

    def parts(self, joints: Tensor) -> dict[str, Tensor]:
        """`flame_parts`, the first joint being the root."""
        return flame_parts(joints, joints[:, 0], self.parents)

    def position_errors(self, a: Mapping[str, Tensor], b: Mapping[str, Tensor]) -> Tensor:
        """Sum over the frames of the distance of each part."""
        along_axes = (a["trajectory"] - b["trajectory"]).abs().sum(-1)
        root, local, all_joints = ((a[p] - b[p]).norm(dim=-1) for p in ("root", "mean_local", "mean_global"))
        return torch.stack([root.sum(), along_axes.sum(), local.mean(1).sum(), all_joints.mean(1).sum()])

    def variance_errors(self, a: Mapping[str, Tensor], b: Mapping[str, Tensor]) -> Tensor:
        """Distance of the variances of each part."""
        root, trajectory, local, all_joints = (a[part].var(0) - b[part].var(0) for part in PARTS)
        return torch.stack([root.norm(), trajectory.norm(), local.norm(dim=-1).mean(), all_joints.mean(0).norm()])

    def average(self, position: Tensor, frames: Tensor) -> Tensor:
        """Each clip counts alike."""
        return (position / frames).mean(0)


class DisplacementErrors(SampleMetric):
    """ADE and FDE: mean distance of the joints, in all predicted frames and in the last of them. In metres.

    The usual definition of motion prediction (Yuan and Kitani 2020): joints and frames of a clip averaged, then clips.
    Of an edit, what was kept does not count, neither frames nor joints; motions of other lengths than the real ones are
    compared up to the end of the shorter. MFM (Table 3) gives no formula, no code and no unit for its numbers, which
    are too large for metres: not comparable.
    """

    higher_is_better = False

    def __init__(self, **kwargs: Any):
        super().__init__(("keys", "errors"), **kwargs)

    def update(
        self,
        joints: Tensor,
        mask: Tensor,
        real_joints: Tensor,
        real_mask: Tensor,
        keys: Tensor,
        kept: Tensor | None = None,
    ) -> None:
        """Adds motions (B, F, J, 3) and the real ones in the same order (B, F', J, 3), with their masks.

        Args:
            joints: generated or edited motions.
            mask: (B, F), True = real frame.
            real_joints: what they are compared with.
            real_mask: (B, F').
            keys: of the motions.
            kept: (B, F, J), True = this joint of this frame was given; None = all were generated.

        Raises:
            ValueError: a motion of which nothing was generated.
        """
        errors = []
        for distance, given in _distances(type(self).__name__, joints, mask, real_joints, real_mask, kept):
            new = ~given
            if not new.any():
                raise ValueError("DisplacementErrors: a motion has no generated frame to compare")
            last = int(new.any(1).nonzero()[-1])
            errors.append(torch.stack([distance[new].mean(), distance[last][new[last]].mean()]))
        if errors:
            self.keep(keys=keys, errors=torch.stack(errors))

    def compute(self) -> dict[str, float | None]:
        """`ade` and `fde`."""
        rows = self.rows("keys", "errors")
        if rows is None:
            return {"ade": None, "fde": None}
        ade, fde = rows[0].mean(0).tolist()
        return {"ade": ade, "fde": fde}


class KeptDrift(SampleMetric):
    """How far what an edit was to keep has moved in the world, in metres. Ours.

    Features that are relative to the root keep steps and poses exactly, and yet let a kept end start wherever the new
    part before it led.
    """

    higher_is_better = False

    def __init__(self, **kwargs: Any):
        super().__init__(("keys", "drift"), **kwargs)

    def update(
        self, joints: Tensor, mask: Tensor, real_joints: Tensor, real_mask: Tensor, keys: Tensor, kept: Tensor
    ) -> None:
        """Adds edits and the motions they were made from; arguments as of `DisplacementErrors`."""
        drift, of = [], []
        name = type(self).__name__
        for number, (distance, given) in enumerate(_distances(name, joints, mask, real_joints, real_mask, kept)):
            if given.any():
                drift.append(torch.stack([distance[given].mean(), distance[given].max()]))
                of.append(number)
        if drift:
            self.keep(keys=keys[of], drift=torch.stack(drift))

    def compute(self) -> dict[str, float | None]:
        """`mean` over the kept joints and frames of a motion, then motions; `largest` of all."""
        rows = self.rows("keys", "drift")
        if rows is None:
            return {"mean": None, "largest": None}
        return {"mean": rows[0][:, 0].mean().item(), "largest": rows[0][:, 1].max().item()}


def _distances(
    name: str, joints: Tensor, mask: Tensor, real_joints: Tensor, real_mask: Tensor, kept: Tensor | None
) -> Iterator[tuple[Tensor, Tensor]]:
    """For each pair of motions, up to the end of the shorter: distances (F, J) in float64, and what was kept (F, J)."""
    motions = zip(real_frames(name, joints, mask), real_frames(name, real_joints, real_mask), strict=True)
    for number, (motion, real) in enumerate(motions):
        length = min(len(motion), len(real))
        distance = (motion[:length].double() - real[:length].double()).norm(dim=-1)
        given = torch.zeros_like(distance, dtype=torch.bool) if kept is None else kept[number][mask[number]][:length]
        yield distance, given
