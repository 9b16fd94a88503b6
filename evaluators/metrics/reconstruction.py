# pyright: standard
"""Errors relative to the real motion for the same text, or to the motion before an edit."""

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from evaluators.metrics.samples import MotionMean
from flame_mdm.representations import rotation
from flame_mdm.representations.rifke import Rifke, upsample

PARTS = ("root", "trajectory", "mean_local", "mean_global")
RIFKE = Rifke()


def temos_parts(joints: Tensor) -> dict[str, Tensor]:
    """Returns the positions that TEMOS compares.

    The positions are root (F, 3), trajectory (F, 2), local (F, 20, 3) and global (F, 21, 3). The
    motion (F, 21, 3), in KIT units, is placed on the floor, and its root starts at x = z = 0 with a
    heading along +z. For the local positions, which exclude the root, each frame is moved and
    turned so that the root is at x = z = 0 and the heading is along +z. `Rifke` defines the floor
    and the heading, including the peculiarities of the published code.
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
    """Returns the positions that FLAME's code compares.

    The positions are root (F, 3), trajectory (F, 2), bones (F, J - 1, 3) and joints (F, J, 3).

    Args:
        joints: (F, J, 3) joint positions in meters.
        root: (F, 3) root positions in meters.
        parents: index of each joint's parent, -1 for the root.
    """
    bones = joints[:, 1:] - joints[:, list(parents[1:])]
    return {"root": root, "trajectory": root[:, [0, 2]], "mean_local": bones, "mean_global": joints}


class PositionErrors(MotionMean):
    """Base class for position errors: APE and AVE for each of `PARTS`, such as `ape_root`. Lower is better.

    Args:
        samples: number of motions per text. If there are several, as in TEMOS, `best_ape_root` etc.
            are the errors of the motion with the smallest root APE, and `worst_ape_root` etc. are
            the errors of the motion with the largest root APE.
        upsampling: number of recorded frames per frame of a motion. If this is above 1, motions are
            interpolated and compared with the recordings.
    """

    higher_is_better = False
    summary = None
    states = ("sums", "counts", "groups")
    parts = tuple(f"{error}_{part}" for error in ("ape", "ave") for part in PARTS)

    def __init__(self, samples: int = 1, upsampling: int = 1):
        super().__init__()
        self.samples, self.upsampling = samples, upsampling
        self.ranked = {"best_": False, "worst_": True} if samples > 1 else {"": False}
        self.names = [f"{prefix}{error}" for prefix in self.ranked for error in self.parts]

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
        """Compares B pairs of motions, each up to the end of the shorter motion.

        Args:
            joints: (B, F, J, 3) generated motions in meters, with y up.
            mask: (B, F) bool, True for real frames.
            real_joints: (B, F', J, 3) real motions for the same texts, in the same order.
            real_mask: (B, F') bool.
            keys: (B,) int64, unique keys of the generated motions.
            groups: (B,) int64, keys of the texts. Only required if `samples` is greater than 1.
            references: B real motions (F'', J, 3) at the frame rate of their recording. Only
                required if `upsampling` is greater than 1.

        Raises:
            UserError: If a motion contains NaN or infinity or has fewer than two frames, or if
                required `references` are missing.
        """
        motions, real_motions = (
            self.real_frames(joints, mask),
            self.real_frames(real_joints, real_mask),
        )
        if self.upsampling > 1:
            if references is None:
                raise self.error(
                    "the store has no recordings. Prepare the data set again with force=true"
                )
            motions, real_motions = (
                [upsample(motion, self.upsampling) for motion in motions],
                list(references),
            )
        errors = []
        for motion, real in zip(motions, real_motions, strict=True):
            a, b = self.positions(motion.double()), self.positions(real.double())
            length = min(len(a["root"]), len(b["root"]))
            self.need(length, 2, "frames in a motion")
            errors.append(
                self.errors(*({part: x[:length] for part, x in side.items()} for side in (a, b)))
            )
        self.add(keys, errors, groups=keys if groups is None or self.samples == 1 else groups)

    def value(self, sums: Tensor, counts: Tensor, groups: Tensor) -> dict[str, float | None]:
        """Returns the errors, keyed by name. Raises `UserError` unless each text has `samples` motions."""
        texts = (
            self.by_group(groups, self.samples)
            if self.samples > 1
            else torch.arange(len(groups))[:, None]
        )
        root, values = (sums[:, 0] / counts[:, 0])[texts], []
        for descending in self.ranked.values():
            first = root.argsort(dim=1, descending=descending, stable=True)[:, :1]
            chosen = texts.gather(1, first)[:, 0]
            values += self.means(sums[chosen], counts[chosen]).values()
        return dict(zip(self.names, values, strict=True))

    def positions(self, joints: Tensor) -> dict[str, Tensor]:
        """Returns the positions to compare for a motion (F, J, 3), keyed by the names in `PARTS`."""
        raise NotImplementedError

    def errors(self, a: Mapping[str, Tensor], b: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Returns the errors of a clip, keyed by name.

        An "ape" error contains one value per frame (F,) or, if all clips have equal weight, only
        the mean over frames.
        """
        raise NotImplementedError


class TemosPositionErrors(PositionErrors):
    """APE and AVE of TEMOS (Petrovich et al. 2022), used by FLAME on KIT (eq. 16 to 18, Table 2).

    APE is the distance between `temos_parts`, averaged over joints and over all frames of all
    clips. AVE is the distance between the variances of the coordinates over time (n - 1 in the
    denominator), averaged over joints and then over clips. The unit of both is 1,000 KIT units,
    that is, 1.56 m, although the tables state meters. TEMOS compares motions at 100 frames per
    second, which corresponds to `upsampling=8`.

    Args:
        samples: number of motions per text; see `PositionErrors`.
        upsampling: number of recorded frames per frame of a motion.

    Example:
        >>> metric, joints = TemosPositionErrors(), torch.rand(1, 5, 21, 3)
        >>> mask = torch.ones(1, 5, dtype=torch.bool)
        >>> metric.update(joints, mask, joints, mask, keys=torch.tensor([0]))
        >>> metric.compute()["ape_root"]
        0.0
    """

    unit = "1,000 KIT units"
    #: KIT units per meter of `joints`, as in the KIT representations.
    units_per_meter = 640.0

    def positions(self, joints: Tensor) -> dict[str, Tensor]:
        """Returns the `temos_parts` of a motion (F, 21, 3), in thousands of KIT units.

        Raises `UserError` for other skeletons.
        """
        if joints.shape[1] != 21:
            raise self.error(
                f"the motions have {joints.shape[1]} joints, but the metric is only defined for "
                "KIT's 21 joints (MMM)"
            )
        return {part: x / 1000 for part, x in temos_parts(joints * self.units_per_meter).items()}

    def errors(self, a: Mapping[str, Tensor], b: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Returns the APE (F,) of each frame and the AVE of the clip, keyed by name."""
        distances = {part: (a[part] - b[part]).norm(dim=-1) for part in PARTS}
        position = {f"ape_{part}": x if x.ndim == 1 else x.mean(1) for part, x in distances.items()}
        return position | {
            f"ave_{part}": (a[part].var(0) - b[part].var(0)).norm(dim=-1).mean() for part in PARTS
        }


class FlamePositionErrors(PositionErrors):
    """APE (in meters) and AVE (in square meters) as in FLAME's code. They are not used in FLAME's tables.

    The positions to compare are `flame_parts`. The error of the trajectory is the sum of the
    distances along its two axes. The local error is the error of the bones. Variances of global
    positions are averaged over joints before they are compared. Each clip has the same weight.
    FLAME's code computes joint positions from the translation of the root, without its orientation.
    In this implementation, `joints` are compared unchanged, and the first joint is the root.

    Args:
        parents: index of each joint's parent in the skeleton, -1 for the root.
        samples: number of motions per text; see `PositionErrors`.

    Example:
        >>> metric, real = FlamePositionErrors(parents=[-1, 0]), torch.zeros(1, 5, 2, 3)
        >>> mask = torch.ones(1, 5, dtype=torch.bool)
        >>> metric.update(real + 1, mask, real, mask, keys=torch.tensor([0]))
        >>> values = metric.compute()
        >>> values["ape_trajectory"], values["ape_mean_local"], values["ave_root"]
        (2.0, 0.0, 0.0)
    """

    def __init__(self, parents: Sequence[int], samples: int = 1):
        super().__init__(samples)
        self.parents = tuple(parents)
        self.units = {name: "m^2" if "ave_" in name else "m" for name in self.names}

    def positions(self, joints: Tensor) -> dict[str, Tensor]:
        """Returns `flame_parts` of a motion (F, J, 3)."""
        return flame_parts(joints, joints[:, 0], self.parents)

    def errors(self, a: Mapping[str, Tensor], b: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Returns the APE (in meters) and AVE (in square meters) of a clip, keyed by name."""
        root, path, local, joints = (a[part] - b[part] for part in PARTS)
        distances = [
            root.norm(dim=-1),
            path.abs().sum(-1),
            local.norm(dim=-1).mean(1),
            joints.norm(dim=-1).mean(1),
        ]
        root, path, local, joints = (a[part].var(0) - b[part].var(0) for part in PARTS)
        variances = [root.norm(), path.norm(), local.norm(dim=-1).mean(), joints.mean(0).norm()]
        return dict(zip(self.parts, [*(x.mean() for x in distances), *variances], strict=True))


class EditErrors(MotionMean):
    """Base class for distances between the joints of edited and real motions, in meters.

    Lower is better.
    """

    higher_is_better = False
    unit = "m"
    summary = None

    def compare(
        self,
        joints: Tensor,
        mask: Tensor,
        real_joints: Tensor,
        real_mask: Tensor,
        keys: Tensor,
        kept: Tensor | None,
    ) -> None:
        """Adds the errors of B pairs of motions; see `update` for the arguments.

        Two motions are compared up to the end of the shorter one.
        """
        motions = zip(
            self.real_frames(joints, mask), self.real_frames(real_joints, real_mask), strict=True
        )
        errors = []
        for row, (motion, real) in enumerate(motions):
            length = min(len(motion), len(real))
            distance = (motion[:length].double() - real[:length].double()).norm(dim=-1)
            old = (
                torch.zeros_like(distance, dtype=torch.bool)
                if kept is None
                else kept[row][mask[row]][:length]
            )
            errors.append(self.errors_of(distance, old))
        self.add(keys, errors)

    def errors_of(self, distance: Tensor, kept: Tensor) -> dict[str, Tensor]:
        """Returns the errors of a motion, or {} if there are none.

        `distance` (F, J) contains distances in meters, and `kept` (F, J) bool marks kept joints.
        """
        raise NotImplementedError


class DisplacementErrors(EditErrors):
    """ADE and FDE: mean joint distance, in meters, over all predicted frames and in the last one.

    As is usual in motion prediction (Yuan and Kitani 2020), distances are averaged over the joints
    and frames of a clip, and then over clips. Parts that an edit kept are ignored. MFM (Table 3)
    states no formula, code or unit for its numbers, which are too large to be in meters and
    therefore not comparable.

    Example:
        >>> metric, real = DisplacementErrors(), torch.zeros(1, 5, 22, 3)
        >>> joints = real + torch.tensor([0.0, 0.5, 0.0])
        >>> mask = torch.ones(1, 5, dtype=torch.bool)
        >>> metric.update(joints, mask, real, mask, keys=torch.tensor([0]))
        >>> metric.compute()
        {'ade': 0.5, 'fde': 0.5}
    """

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
        """Compares B pairs of motions, each up to the end of the shorter motion.

        Args:
            joints: (B, F, J, 3) generated motions in meters.
            mask: (B, F) bool, True for real frames.
            real_joints: (B, F', J, 3) real motions, in the same order.
            real_mask: (B, F') bool.
            keys: (B,) int64, unique keys of the generated motions.
            kept: (B, F, J) bool, True if the edit kept this joint in this frame. If None,
                everything was generated.

        Raises:
            UserError: If a motion contains NaN or infinity, or has no generated frames.
        """
        self.compare(joints, mask, real_joints, real_mask, keys, kept)

    def errors_of(self, distance: Tensor, kept: Tensor) -> dict[str, Tensor]:
        """Returns the ADE and FDE of a motion from distances (F, J) and kept joints (F, J) bool."""
        new = ~kept
        if not new.any():
            raise self.error("a motion has no generated frame to compare")
        last = int(new.any(1).nonzero()[-1])
        return {"ade": distance[new].mean(), "fde": distance[last][new[last]].mean()}


class KeptDrift(EditErrors):
    """How far, in meters, an edit has moved kept joints in world coordinates.

    This metric was introduced in this project. `mean` is the distance averaged over the kept joints
    and frames of a motion, and then over motions. `largest` is the maximum over all kept joints,
    frames and motions. If features are relative to the root, an edit can keep steps and poses
    exactly and still move a kept ending, because the ending begins where the new part ends.

    Example:
        >>> metric, real = KeptDrift(), torch.zeros(1, 5, 22, 3)
        >>> joints, mask = real + torch.tensor([0.0, 0.5, 0.0]), torch.ones(1, 5, dtype=torch.bool)
        >>> kept = torch.ones(1, 5, 22, dtype=torch.bool)
        >>> metric.update(joints, mask, real, mask, keys=torch.tensor([0]), kept=kept)
        >>> metric.compute()
        {'mean': 0.5, 'largest': 0.5}
    """

    names = ("mean", "largest")

    def update(
        self,
        joints: Tensor,
        mask: Tensor,
        real_joints: Tensor,
        real_mask: Tensor,
        keys: Tensor,
        kept: Tensor,
    ) -> None:
        """Compares B pairs of motions, each up to the end of the shorter motion.

        Args:
            joints: (B, F, J, 3) edited motions in meters.
            mask: (B, F) bool, True for real frames.
            real_joints: (B, F', J, 3) motions before editing, in the same order.
            real_mask: (B, F') bool.
            keys: (B,) int64, unique keys of the edited motions.
            kept: (B, F, J) bool, True if the edit kept this joint in this frame.

        Raises:
            UserError: If a motion contains NaN or infinity.
        """
        self.compare(joints, mask, real_joints, real_mask, keys, kept)

    def errors_of(self, distance: Tensor, kept: Tensor) -> dict[str, Tensor]:
        """Returns the mean and the maximum distance of the kept joints of a motion.

        Returns {} if no joints were kept.
        """
        return (
            {"mean": distance[kept].mean(), "largest": distance[kept].max()} if kept.any() else {}
        )

    def value(self, sums: Tensor, counts: Tensor) -> dict[str, float | None]:
        """Returns `mean` and `largest` over the motions with kept joints.

        Both are None if there are no such motions.
        """
        drift = sums[counts[:, 0] > 0]
        values = (
            (drift[:, 0].mean().item(), drift[:, 1].max().item()) if len(drift) else (None, None)
        )
        return dict(zip(self.names, values, strict=True))
