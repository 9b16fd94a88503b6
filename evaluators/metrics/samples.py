"""Base classes of metrics: shares of events, and values computed from all samples, sorted by key."""

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor
from torchmetrics import Metric
from torchmetrics.utilities import dim_zero_cat

from flame_mdm.errors import UserError

Value = float | dict[str, float | None] | None
"""What `compute` returns: a number, or numbers by name; None without samples."""


class MotionMetric(Metric):
    """Base class of all metrics. Several take `seed`, that of their random draws."""

    full_state_update = False
    names: Sequence[str] = ()  # names of the values; empty if there is only one

    @property
    def update_called(self) -> bool:
        """Always True: a metric without samples returns None, without a warning."""
        return True

    def error(self, message: str) -> UserError:
        return UserError(f"{type(self).__name__}: {message}")

    def need(self, count: int, least: int, what: str) -> None:
        """Raises `UserError` if `count` is less than `least`."""
        if count < least:
            raise self.error(f"got {count} {what}, needs at least {least}")

    def real_frames(self, joints: Tensor, mask: Tensor) -> list[Tensor]:
        """Splits joints (B, F, J, 3) with mask (B, F) into motions (F, J, 3), whose sums are the same in every batch.

        Raises `UserError` if a motion contains NaN or infinity.
        """
        frames = joints.detach()[mask]
        motions = list(frames.split(mask.sum(1).tolist()))
        # A sum is finite only if all numbers are, and is faster to compute.
        bad = 0 if frames.sum().isfinite() else sum(not bool(motion.isfinite().all()) for motion in motions)
        if bad:
            raise self.error(f"{bad} of {len(motions)} motions are not finite. Did the model diverge?")
        return motions


class Timed(MotionMetric):
    """A metric that depends on `fps`, the frame rate of the motions."""

    def __init__(self, fps: float):
        super().__init__()
        self.fps = fps


class Share(MotionMetric):
    """A share of events, or one share per name. Counts are whole numbers, so sums do not depend on their order."""

    hits: Tensor
    total: Tensor

    def __init__(self):
        super().__init__()
        for state in ("hits", "total"):
            self.add_state(state, torch.zeros(len(self.names) or 1, dtype=torch.long), dist_reduce_fx="sum")

    def count(self, events: Mapping[str, bool]) -> None:
        """Counts one event for some of the names: True = a hit."""
        for name, hit in events.items():
            self.hits[self.names.index(name)] += int(hit)
            self.total[self.names.index(name)] += 1

    def compute(self) -> Any:
        """Returns the share in [0, 1], or one by name; None for what was never counted."""
        counts = zip(self.hits.tolist(), self.total.tolist(), strict=True)
        shares = [hits / total if total else None for hits, total in counts]
        return dict(zip(self.names, shares, strict=True)) if self.names else shares[0]


class SampleMetric(MotionMetric):
    """A metric that keeps one row per sample and computes its value from all rows, sorted by key.

    The value therefore does not depend on the batches, their order or the number of processes. Processes may hold any
    number of samples, including none. `value` is the formula.

    Attributes:
        states: names of the kept rows, in the order of the arguments of `value`. Each row also has a key. Unless
            `update` is overridden, they are its inputs.
    """

    states: tuple[str, ...]

    def __init__(self):
        super().__init__()
        for name in ("keys", *self.states):
            self.add_state(name, [], dist_reduce_fx="cat")

    def update(self, **rows: Any) -> None:
        """Adds equally many rows by the names of their states, which include the keys; `ValueError` otherwise."""
        if len({len(values) for values in rows.values()}) > 1:
            sizes = ", ".join(f"{len(values)} {name}" for name, values in rows.items())
            raise ValueError(f"{type(self).__name__}: got {sizes}")
        for name, values in rows.items():
            getattr(self, name).append(values.detach())

    def compute(self) -> Any:
        """Returns the `value` of all rows; None, or None by name, if there are none."""
        rows = self.rows("keys", *self.states)
        return self.value(*rows) if rows else self.nothing

    @property
    def nothing(self) -> Value:
        return dict.fromkeys(self.names) if self.names else None

    def value(self, *rows: Tensor) -> Value:
        """Computes the value from all rows, in the order of their keys."""
        raise NotImplementedError

    def rows(self, keys: str, *names: str) -> list[Tensor]:
        """Returns finite rows in the order of their keys, floats as float64; [] if there are none."""
        if not getattr(self, keys):
            return []
        order = self.order(keys)
        sorted_rows = []
        for name in names:
            values = dim_zero_cat(getattr(self, name))[order]
            if values.is_floating_point():
                values = values.double()
                bad = int((~values.isfinite().reshape(len(values), -1).all(1)).sum())
                if bad:
                    raise self.error(
                        f"{bad} of {len(values)} rows of {name!r} are not finite. "
                        "Look for damaged motions in the data, or a model that diverged"
                    )
            sorted_rows.append(values)
        return sorted_rows if len(order) else []

    def order(self, keys: str) -> Tensor:
        """Returns the indices that sort samples by their keys. Raises `UserError` if two samples have the same key."""
        values, order = dim_zero_cat(getattr(self, keys)).sort()
        twice = int((values[1:] == values[:-1]).sum())
        if twice:
            raise self.error(
                f"{twice} samples were given twice ({keys}). Evaluate each once: use a sampler that does not pad, and "
                "a different key for each sample of a prompt"
            )
        return order

    def by_group(self, groups: Tensor, samples: int) -> Tensor:
        """Returns the indices (C, S) of the samples of each group; raises `UserError` if one has not S samples."""
        names, sizes = groups.unique(return_counts=True)
        wrong = int((sizes != samples).sum())
        if wrong:
            raise self.error(
                f"{wrong} of {len(names)} prompts do not have {samples} motions but {int(sizes.min())} to "
                f"{int(sizes.max())}. Generate {samples} for each"
            )
        return groups.argsort(stable=True).unflatten(0, (len(names), samples))

    def _sync_dist(self, dist_sync_fn: Any = None, process_group: Any | None = None) -> None:
        """Gathers the rows of all processes. The default of torchmetrics fails if a process has none."""
        states = {name: [rows.cpu() for rows in getattr(self, name)] for name in self._reductions}
        group = process_group or self.process_group
        gathered: list[Any] = [None] * torch.distributed.get_world_size(group)
        torch.distributed.all_gather_object(gathered, states, group=group)
        for name in states:
            setattr(self, name, [rows.to(self.device) for part in gathered for rows in part[name]])


class TwoSets(SampleMetric):
    """A metric that compares the set of features of generated motions with that of real motions."""

    states = ("generated",)

    def __init__(self):
        super().__init__()
        for name in ("real_keys", "real"):
            self.add_state(name, [], dist_reduce_fx="cat")

    def update(
        self,
        generated: Tensor | None = None,
        keys: Tensor | None = None,
        real: Tensor | None = None,
        real_keys: Tensor | None = None,
    ) -> None:
        """Adds generated (B, E) and real (R, E) features with their keys, in the same call or separately."""
        if generated is not None:
            super().update(keys=keys, generated=generated)
        if real is not None:
            super().update(real_keys=real_keys, real=real)

    def compute(self) -> Any:
        """Returns the value of generated (N, E) and real (M, E) features; None, or None by name, if a set is empty."""
        generated, real = self.rows("keys", "generated"), self.rows("real_keys", "real")
        return self.value(*generated, *real) if generated and real else self.nothing
