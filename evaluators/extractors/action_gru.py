"""The action classifier of HumanAct12: a GRU over joint positions (Guo et al. 2020, "Action2Motion")."""

import torch
from torch import Tensor, nn

NUM_ACTIONS = 12


class ActionGRU(nn.Module):
    """Action classifier with two GRU layers over joint positions; it classifies the state at the last real frame.

    The released weights provide the features and the accuracy in every HumanAct12 table. The authors draw the initial
    state from a normal distribution in every call, so their numbers are random even for fixed motions. Here, the
    initial state is zero, unless one is given (`random_state` draws it as the authors do).
    """

    features = 30

    def __init__(self, num_joints: int = 24, hidden: int = 128, num_layers: int = 2, *, num_actions: int = NUM_ACTIONS):
        super().__init__()
        self.recurrent = nn.GRU(3 * num_joints, hidden, num_layers, batch_first=True)
        self.linear1 = nn.Linear(hidden, self.features)
        self.linear2 = nn.Linear(self.features, num_actions)

    def forward(self, joints: Tensor, mask: Tensor, state: Tensor | None = None) -> Tensor:
        """Returns features (B, 30) in (-1, 1) of motions, which the network sees with y down and from the first pelvis.

        Args:
            joints: (B, F, J, 3) in meters, y up; the 24 SMPL joints for the released weights.
            mask: (B, F) bool, True = real frame; every motion has at least one.
            state: (layers, B, hidden) initial state; None = zeros.
        """
        joints = joints * joints.new_tensor([1.0, -1.0, -1.0])
        return self.published(joints - joints[:, :1, :1], mask, state)

    def published(self, x: Tensor, mask: Tensor, state: Tensor | None = None) -> Tensor:
        """Returns features (B, 30) of what the network sees (B, F, J, 3); other arguments as for `forward`."""
        outputs, _ = self.recurrent(x.flatten(2), state)
        last = mask.sum(1) - 1
        return torch.tanh(self.linear1(outputs[torch.arange(len(last), device=last.device), last]))

    def logits(self, joints: Tensor, mask: Tensor, state: Tensor | None = None) -> Tensor:
        """Returns unnormalized log-probabilities (B, actions) of the actions; arguments as for `forward`."""
        return self.linear2(self(joints, mask, state))

    def random_state(self, batch: int, generator: torch.Generator) -> Tensor:
        """Draws an initial state (layers, B, hidden) from a standard normal distribution, as the authors do."""
        shape = (self.recurrent.num_layers, batch, self.recurrent.hidden_size)
        return torch.randn(shape, generator=generator).to(self.linear1.weight)
