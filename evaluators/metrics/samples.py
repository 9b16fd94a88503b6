"""What all metrics share: samples are kept, put in order, and measured together."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torchmetrics import Metric
from torchmetrics.utilities import dim_zero_cat


def real_frames(name: str, joints: Tensor, mask: Tensor) -> list[Tensor]:
    """Motions (F, J, 3) of their own lengths out of joints (B, F, J, 3) and mask (B, F).

    Sums over a motion without its padding round alike in every batch.

    Raises:
        ValueError: a motion is not finite; `name` says who refuses it.
    """
    motions = [motion[real].detach() for motion, real in zip(joints, mask, strict=True)]
    bad = sum(not bool(motion.isfinite().all()) for motion in motions)
    if bad:
        raise ValueError(f"{name}: {bad} of {len(motions)} motions are not finite; did the model diverge?")
    return motions


class SampleMetric(Metric):
    """A metric that keeps a row a sample and measures all of them, sorted by key, in `compute`.

    So the value depends neither on batches nor on their order nor on the number of processes, and processes may hold
    any number of samples, none too.

    Args:
        sets: names of tensors that belong together row by row; the first of each set are the keys.
        kwargs: options of `torchmetrics.Metric`.
    """

    full_state_update = False

    def __init__(self, *sets: tuple[str, ...], **kwargs: Any):
        super().__init__(**kwargs)
        for name in (name for names in sets for name in names):
            self.add_state(name, [], dist_reduce_fx="cat")

    @property
    def update_called(self) -> bool:
        """Always: that nothing was given is told by the value None, not by a warning."""
        return True

    def keep(self, **rows: Tensor) -> None:
        """Adds rows of one set.

        Raises:
            ValueError: not as many of one name as of the others.
        """
        if len({len(values) for values in rows.values()}) > 1:
            sizes = ", ".join(f"{len(values)} {name}" for name, values in rows.items())
            raise ValueError(f"{type(self).__name__}: got {sizes}; give one of each for a sample")
        for name, values in rows.items():
            getattr(self, name).append(values.detach())

    def rows(self, keys: str, *names: str) -> list[Tensor] | None:
        """The rows of a set in the order of their keys, floating numbers as float64; None where there are none.

        Raises:
            ValueError: a sample was given twice, or is not finite.
        """
        if not getattr(self, keys):
            return None
        order = self.order(keys)
        sorted_rows = []
        for name in names:
            values = dim_zero_cat(getattr(self, name))[order]
            if values.is_floating_point():
                values = values.double()
                bad = int((~values.isfinite().reshape(len(values), -1).all(1)).sum())
                if bad:
                    raise ValueError(
                        f"{type(self).__name__}: {bad} of {len(values)} rows of {name!r} are not finite; "
                        "look for motions that are not, in the data or because the model diverged"
                    )
            sorted_rows.append(values)
        return sorted_rows if len(order) else None

    def order(self, keys: str) -> Tensor:
        """Indices that sort a set by its keys.

        Raises:
            ValueError: two samples have the same key.
        """
        values, order = dim_zero_cat(getattr(self, keys)).sort()
        twice = int((values[1:] == values[:-1]).sum())
        if twice:
            raise ValueError(
                f"{type(self).__name__}: {twice} samples were given twice ({keys}); evaluate each once, with a sampler "
                "that does not pad and with a key of its own for each sample of a prompt"
            )
        return order

    def need(self, count: int, least: int, what: str) -> None:
        """Raises ValueError where there are fewer than `least`."""
        if count < least:
            raise ValueError(f"{type(self).__name__}: got {count} {what}, needs at least {least}")

    def _sync_dist(self, dist_sync_fn: Any = None, process_group: Any | None = None) -> None:
        """Gathers the rows of all processes; torchmetrics' own way fails where one of them has none."""
        states = {name: [rows.cpu() for rows in getattr(self, name)] for name in self._reductions}
        group = process_group or self.process_group
        gathered: list[Any] = [None] * torch.distributed.get_world_size(group)
        torch.distributed.all_gather_object(gathered, states, group=group)
        for name in states:
            setattr(self, name, [rows.to(self.device) for part in gathered for rows in part[name]])


def by_group(metric: SampleMetric, groups: Tensor, samples: int) -> Tensor:
    """Indices (C, S) of the samples of each group; ValueError where one has not S."""
    names, sizes = groups.unique(return_counts=True)
    wrong = int((sizes != samples).sum())
    if wrong:
        raise ValueError(
            f"{type(metric).__name__}: {wrong} of {len(names)} prompts have not {samples} motions "
            f"but {int(sizes.min())} to {int(sizes.max())}; generate {samples} for each"
        )
    return groups.argsort(stable=True).unflatten(0, (len(names), samples))


class TwoSets(SampleMetric):
    """A metric that compares the features of generated motions as a set with those of real ones."""

    def __init__(self, **kwargs: Any):
        super().__init__(("keys", "generated"), ("real_keys", "real"), **kwargs)

    def update(
        self,
        generated: Tensor | None = None,
        keys: Tensor | None = None,
        real: Tensor | None = None,
        real_keys: Tensor | None = None,
    ) -> None:
        """Adds generated (B, E) and real (R, E) features with their keys, together or one after the other."""
        for name, features, ids in (("generated", generated, keys), ("real", real, real_keys)):
            if features is not None:
                key_name = "keys" if name == "generated" else "real_keys"
                if ids is None:
                    raise ValueError(f"{type(self).__name__}: {name!r} came without {key_name!r}")
                self.keep(**{key_name: ids, name: features})

    def sets(self) -> tuple[Tensor, Tensor] | None:
        """Generated (N, E) and real (M, E) features, float64, in the order of their keys; None where one is empty.

        Raises:
            ValueError: the two have different widths.
        """
        generated, real = self.rows("keys", "generated"), self.rows("real_keys", "real")
        if generated is None or real is None:
            return None
        widths = generated[0].shape[1], real[0].shape[1]
        if widths[0] != widths[1]:
            raise ValueError(f"{type(self).__name__}: features are {widths[0]} wide if generated, {widths[1]} if real")
        return generated[0], real[0]
