"""Action labels as conditions: a table of learned vectors."""

import torch
from torch import nn

from flame_mdm.batch import Condition, MotionBatch
from flame_mdm.conditions import ConditionEncoder
from flame_mdm.errors import UserError


class ActionLabels(ConditionEncoder):
    """Encoder with one learned vector per action label, initialized from N(0, 1).

    The null condition is the zero vector.

    Source: Tevet et al. 2023 (MDM), section 3. For denoisers that read tokens, the pooled vector
    also serves as the only token.

    Args:
        features: C, the width of the vectors.
        num_actions: number of action labels in the data set.

    Raises:
        UserError: If there are no labels.

    Example:
        >>> encoder = ActionLabels(features=4, num_actions=3)
        >>> x = torch.zeros(2, 5, 3)
        >>> batch = MotionBatch(x, x[..., 0] == 0, ["a", "b"], action=torch.tensor([0, 2]))
        >>> cond = encoder(batch)
        >>> torch.equal(cond.pooled, encoder.table[[0, 2]]), cond.null.pooled.tolist()
        (True, [[0.0, 0.0, 0.0, 0.0]])
    """

    reads = "action"

    def __init__(self, features: int, num_actions: int):
        super().__init__()
        if num_actions < 1:
            raise UserError(
                "condition=action requires a data set with action labels, but this data set has none or "
                "is not prepared yet. Run make prepare first, or choose another data set"
            )
        self.features = features
        self.table = nn.Parameter(torch.randn(num_actions, features))

    def forward(self, batch: MotionBatch) -> Condition:
        """Returns the learned vector for each label in `batch.action` (B,).

        Raises:
            UserError: If the batch contains no labels.
        """
        if batch.action is None:
            raise UserError(
                "condition=action requires action labels, but this batch has none. Choose a data "
                "set with labels"
            )
        pooled, nothing = (
            self.table[batch.action.to(self.table.device)],
            torch.zeros_like(self.table[:1]),
        )
        token_mask = torch.ones(pooled.shape[0], 1, dtype=torch.bool, device=pooled.device)
        null = Condition(nothing, nothing[:, None], token_mask.new_ones(1, 1))
        return Condition(pooled, pooled[:, None], token_mask, null)
