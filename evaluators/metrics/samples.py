# pyright: standard
"""Base classes for metrics that are computed from all samples, sorted by key."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torchmetrics import Metric
from torchmetrics.utilities import dim_zero_cat

from flame_mdm.errors import UserError

Value = float | dict[str, float | None] | None
"""Result of `compute`: a number, numbers by name, or None if there are no samples."""

Rows = Mapping[str, Any]
"""Inputs for N motions by their names in `evaluators.metrics`, such as tensors with N rows."""


class Declared:
    """Base class for a metric's properties and its values for single samples and resamples.

    Attributes:
        unit: unit of the values; "" = a number without a unit.
        units: units of the values whose unit differs from `unit`, keyed by name.
        directions: whether higher is better, keyed by name, for values to which `higher_is_better`
            does not apply. A value is None if neither direction is better.
        summary: name of the value that summarizes the other values, or None if there is no such
            value.
        audited: names of the values that audits show, or None for all values.
        sees_meaning: whether the metric may detect that a motion does not show what was requested.
        exact: name of the value that evaluates the requested attributes without a network, or None
            if there is no such value.
        depends_on_count: whether the bias of the value depends on the number of motions.
    """

    higher_is_better: bool | None
    unit: str = ""
    units: Mapping[str, str] = {}
    directions: Mapping[str, bool | None] = {}
    summary: str | None = ""
    audited: Sequence[str] | None = None
    sees_meaning = True
    exact: str | None = None
    depends_on_count = False

    def unit_of(self, name: str) -> str:
        """Returns the unit of a value. If a metric has only one value, its name is ""."""
        return self.units.get(name, self.unit)

    def direction_of(self, name: str) -> bool | None:
        """Returns whether higher is better for the value with this name.

        The result is None if neither direction is better, or if the value for real motions is the
        best value.
        """
        return self.directions.get(name, self.higher_is_better)

    def readings(self, motions: Rows) -> dict[str, np.ndarray]:
        """Returns the condition-independent measurements of motions, keyed by name.

        Each reading is an array with N rows. Metrics computed from features need no readings.
        """
        return {}

    def per_sample(self, rows: Rows) -> dict[str, Tensor]:
        """Returns each sample's value and weight (N, 2), keyed by the name of the value.

        The metric is the weighted mean. If it uses random pools, the values are averaged over all
        possible draws. Returns {} if the metric has no values for individual samples. `rows`
        contains the inputs of the metric and its `readings`. Raises `UserError` if there are too
        few samples.
        """
        return {}

    def weighted(self, rows: Rows, weights: np.ndarray) -> dict[str, np.ndarray]:
        """Computes the values for R resamples of N samples, each as (R,), keyed by name.

        `weights` (R, N) states how often each sample was drawn. See `per_sample` for
        `rows`. Returns {} if the metric cannot be resampled.
        """
        values = {}
        for name, pairs in self.per_sample(rows).items():
            pair, times = np.asarray(pairs), weights[:, : len(pairs)]
            with np.errstate(invalid="ignore"):
                values[name] = times @ pair[:, 0] / (times @ pair[:, 1])
        return values


class SampleMetric(Declared, Metric):
    """Base class for metrics that are computed from one row per sample, with rows sorted by key.

    Therefore, the value does not depend on the batches, their order or the number of ranks, and a
    rank may have no samples. Subclasses implement the formula in `value`. If a metric draws at
    random, its `seed` argument determines the draws.

    A class also declares the properties that are needed to interpret its values; see `Declared`.

    Attributes:
        states: names of the tensors with one row per sample, in the order of the arguments of
            `value`. Each row also has a key. Unless a class overrides `update`, the states are its
            inputs.
        names: names of the values; empty if there is only one value.

    Example:
        >>> class MeanFeature(SampleMetric):  # a metric consists of its inputs and a formula
        ...     states = ("generated",)
        ...     def value(self, generated):
        ...         return generated.mean().item()
        >>> metric = MeanFeature()
        >>> metric.update(generated=torch.tensor([[1.0], [3.0]]), keys=torch.tensor([7, 8]))
        >>> metric.compute()
        2.0
    """

    full_state_update = False
    states: tuple[str, ...]
    names: Sequence[str] = ()

    def __init__(self):
        super().__init__()
        for name in ("keys", *self.states):
            self.add_state(name, [], dist_reduce_fx="cat")

    @property
    def update_called(self) -> bool:
        """Always True, so that torchmetrics does not warn about a metric without samples."""
        return True

    def update(self, *_: Any, **rows: Any) -> None:
        """Stores a batch of B samples.

        Args:
            rows: one keyword argument per state, and `keys` (B,) int64, all with B rows. The
                docstring of `evaluators.metrics` lists shapes and units.

        Raises:
            ValueError: If the arguments have different numbers of rows.
        """
        if len({len(values) for values in rows.values()}) > 1:
            sizes = ", ".join(f"{len(values)} {name}" for name, values in rows.items())
            raise ValueError(f"{type(self).__name__}: got {sizes}")
        for name, values in rows.items():
            getattr(self, name).append(values.detach())

    def compute(self) -> Any:
        """Returns the metric computed over all samples.

        If there are no samples, the metric (or each of its values) is None.
        """
        rows = self.rows("keys", *self.states)
        return self.value(*rows) if rows else self.nothing

    @property
    def nothing(self) -> Value:
        """The value if there are no samples: None, or a mapping from each name to None."""
        return dict.fromkeys(self.names) if self.names else None

    def value(self, *rows: Any, **_: Any) -> Value:
        """Computes the value from all rows, which are sorted by key."""
        raise NotImplementedError

    def drawn_value(self, drawn: Tensor, real_drawn: Tensor) -> Value:
        """Computes the value for samples drawn with replacement (bootstrap).

        Args:
            drawn: (N,) indices of the drawn samples, counted in the order in which the samples were
                added.
            real_drawn: (M,) indices of the drawn real motions, if the metric compares two sets.
        """
        return self.value(*self._taken(drawn, *self.states))

    def _taken(self, drawn: Tensor, *names: str) -> list[Tensor]:
        rows = [dim_zero_cat(getattr(self, name))[drawn] for name in names]
        return [values.double() if values.is_floating_point() else values for values in rows]

    def rows(self, keys: str, *names: str) -> list[Tensor]:
        """Returns the stored rows, sorted by key, or [] if there are no rows.

        The rows must not contain NaN or infinity. Floating-point numbers are returned as float64.
        """
        if not getattr(self, keys):
            return []
        order = self.order(keys)
        sorted_rows = []
        for name in names:
            values = dim_zero_cat(getattr(self, name))[order]
            if values.is_floating_point():
                values = values.double()
                if bad := int((~values.isfinite().reshape(len(values), -1).all(1)).sum()):
                    raise self.error(
                        f"{bad} of {len(values)} rows of {name!r} contain NaN or infinity. Did the model diverge?"
                    )
            sorted_rows.append(values)
        return sorted_rows if len(order) else []

    def order(self, keys: str) -> Tensor:
        """Returns the indices that sort samples by their keys.

        Raises `UserError` if two samples have the same key.
        """
        values, order = dim_zero_cat(getattr(self, keys)).sort()
        if twice := int((values[1:] == values[:-1]).sum()):
            raise self.error(
                f"{twice} samples were added twice ({keys}). Evaluate each sample once, with "
                f"its own key"
            )
        return order

    def by_group(self, groups: Tensor, samples: int) -> Tensor:
        """Returns the indices (C, S) of the samples of each group.

        Raises `UserError` unless each group has S samples.
        """
        names, sizes = groups.unique(return_counts=True)
        if wrong := int((sizes != samples).sum()):
            have = f"{wrong} of {len(names)} prompts do not have {samples} motions"
            raise self.error(
                f"{have}: found {int(sizes.min())} to {int(sizes.max())}. Generate {samples} motions per prompt"
            )
        return groups.argsort(stable=True).unflatten(0, (len(names), samples))

    def error(self, message: str) -> UserError:
        """Returns an error whose message begins with the name of the metric."""
        return UserError(f"{type(self).__name__}: {message}")

    def need(self, count: int, least: int, noun: str) -> None:
        """Raises `UserError` if `count` is less than `least`."""
        if count < least:
            raise self.error(f"got {count} {noun}, but needs at least {least}")

    def real_frames(self, joints: Tensor, mask: Tensor) -> list[Tensor]:
        """Splits padded joints (B, F, J, 3) with mask (B, F) into motions (F, J, 3).

        Without padding, sums over a motion are the same in every batch. Raises `UserError` if a
        motion contains NaN or infinity.
        """
        frames = joints.detach()[mask]
        motions = list(frames.split(mask.sum(1).tolist()))
        # The sum is finite only if all numbers are finite, and checking it is faster.
        if not frames.sum().isfinite():
            bad = sum(not bool(motion.isfinite().all()) for motion in motions)
            raise self.error(
                f"{bad} of {len(motions)} motions contain NaN or infinity. Did the model diverge?"
            )
        return motions

    def _sync_dist(self, dist_sync_fn: Any = None, process_group: Any | None = None) -> None:
        """Gathers the rows of all ranks.

        This replaces torchmetrics' implementation, which fails if a rank has no rows.
        """
        states = {name: [rows.cpu() for rows in getattr(self, name)] for name in self._reductions}
        group = process_group or self.process_group
        gathered: list[Any] = [None] * torch.distributed.get_world_size(group)
        torch.distributed.all_gather_object(gathered, states, group=group)
        for name in states:
            setattr(self, name, [rows.to(self.device) for part in gathered for rows in part[name]])


class Timed(SampleMetric):
    """Base class for metrics that depend on `fps`, the number of frames per second."""

    def __init__(self, fps: float):
        super().__init__()
        self.fps = fps


class MotionMean(SampleMetric):
    """Base class for metrics that average values over motions.

    A motion contributes one value, one value per frame, or any other number of values.
    """

    states = ("sums", "counts")
    #: Names of the values measured on a motion, if `names` also contains other names.
    parts: Sequence[str] = ()

    def add(self, keys: Tensor, motions: Sequence[Any], **more: Tensor) -> None:
        """Adds the values of motions.

        Args:
            keys: (B,) int64, unique keys of the motions.
            motions: B numbers or tensors, such as one number per frame. If the metric has `names`,
                B mappings from names to numbers or tensors. Values that are NaN or missing are
                undefined and are not counted.
            more: additional states with B rows each.
        """
        names, rows = self.parts or self.names, []
        for motion in motions:
            values = [motion.get(name, torch.nan) for name in names] if names else [motion]
            numbers = [torch.as_tensor(value, dtype=torch.float64) for value in values]
            defined = [x[~x.isnan()] for x in numbers]
            rows.append([[float(x.sum()) for x in defined], [len(x) for x in defined]])
        if rows:
            sums, counts = torch.tensor(rows, dtype=torch.float64).unbind(1)
            SampleMetric.update(self, keys=keys, sums=sums, counts=counts, **more)

    def value(self, *rows: Any, **_: Any) -> Value:
        """Returns the means; see `means`."""
        return self.means(*rows)

    def means(self, sums: Tensor, counts: Tensor) -> Any:
        """Returns the mean of all values or, if the metric has `names`, a mapping from names to means.

        The mean is None if there are no values.
        """
        totals = zip(sums.sum(0).tolist(), counts.sum(0).tolist(), strict=True)
        means = [total / count if count else None for total, count in totals]
        return dict(zip(self.parts or self.names, means, strict=True)) if self.names else means[0]

    def per_sample(self, rows: Rows) -> dict[str, Tensor]:
        """Returns the sum and count (N, 2) of each motion's values, keyed by name."""
        names = self.parts or self.names or [""]
        return {name: torch.as_tensor(rows[name]) for name in names if name in rows}


class JointMean(MotionMean):
    """Base class for metrics that average values measured on the joints of individual motions."""

    sees_meaning = False

    def update(self, joints: Tensor, mask: Tensor, keys: Tensor) -> None:
        """Adds B motions.

        Args:
            joints: (B, F, J, 3) positions in meters, with y up and the floor at y = 0.
            mask: (B, F) bool, True for real frames.
            keys: (B,) int64, unique keys of the motions.

        Raises:
            UserError: If a real frame contains NaN or infinity.
        """
        self.add(keys, [self.measure(motion) for motion in self.real_frames(joints, mask)])

    def measure(self, motion: Tensor) -> Any:
        """Computes the values of a motion (F, J, 3), keyed by name if the metric has `names`.

        Values that are NaN or missing are undefined.
        """
        raise NotImplementedError

    def readings(self, motions: Rows) -> dict[str, np.ndarray]:
        """Returns the sum and count (N, 2) of each motion's values, keyed by name."""
        self.reset()
        for i, joints in enumerate(motions["joints"]):
            mask = torch.ones(1, len(joints), dtype=torch.bool)
            self.update(joints[None], mask, motions["keys"][i : i + 1], **self.extras(motions, i))
        pairs = torch.stack(
            [torch.cat(getattr(self, state)) for state in ("sums", "counts")], 1
        ).numpy()
        names = self.parts or self.names or [""]
        return {name: pairs[..., k] for k, name in enumerate(names) if pairs[:, 1, k].any()}

    def extras(self, motions: Rows, i: int) -> dict[str, Any]:
        """Returns additional inputs of `update` for motion i."""
        return {}


class TwoSets(SampleMetric):
    """Base class for metrics that compare two sets of features: generated motions and real motions."""

    states = ("generated",)
    depends_on_count = True

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
        """Adds features of generated motions and of real motions, together or separately.

        Args:
            generated: (B, E) features of generated motions.
            keys: (B,) int64, unique keys of the generated motions.
            real: (R, E) features of real motions.
            real_keys: (R,) int64, unique keys of the real motions.

        Raises:
            ValueError: If features and keys have different numbers of rows.
        """
        if generated is not None:
            super().update(keys=keys, generated=generated)
        if real is not None:
            super().update(real_keys=real_keys, real=real)

    def compute(self) -> Any:
        """Returns the metric computed from both sets.

        If a set is empty, the metric (or each of its values) is None.
        """
        generated, real = self.rows("keys", "generated"), self.rows("real_keys", "real")
        return self.value(*generated, *real) if generated and real else self.nothing

    def drawn_value(self, drawn: Tensor, real_drawn: Tensor) -> Value:
        """Computes the value from the indices of drawn samples (N,) and drawn real motions (M,)."""
        return self.value(*self._taken(drawn, "generated"), *self._taken(real_drawn, "real"))
