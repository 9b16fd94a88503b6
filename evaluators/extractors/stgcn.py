# pyright: standard
"""Action classifiers with spatial-temporal graph convolutions (Yan et al. 2018, "ST-GCN")."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from flame_mdm.representations.skeleton import SMPL24

UNCONSTRAINED_JOINTS = (15, 12, 16, 18, 20, 17, 19, 21, 0, 1, 4, 7, 2, 5, 8)
UNCONSTRAINED_PARENTS = (1, -1, 1, 2, 3, 1, 5, 6, 1, 8, 9, 10, 8, 12, 13)
"""The 15 SMPL joints in MDM's unconstrained evaluation, and their parents. The neck is the root."""
TEMPORAL_KERNEL = 9


def adjacency(parents: Sequence[int]) -> Tensor:
    """Returns the three matrices of a graph convolution, as (3, V, V).

    The first matrix gathers from the vertex itself, the second from neighbors that are not nearer
    to the root, and the third from neighbors that are nearer to the root.

    Entry (v, w) is the weight of vertex v in the sum for vertex w, divided by the number of
    vertices that contribute to w. In the authors' code, all vertices beyond distance 1 from the
    root count as equally far from it. Therefore, the spatial partition of Yan et al. 2018 (section
    3.3) affects only the vertices next to the root.
    """
    size, root = len(parents), parents.index(-1)
    linked = torch.eye(size)
    for child, parent in enumerate(parents):
        if parent >= 0:
            linked[child, parent] = linked[parent, child] = 1
    gathered = linked / linked.sum(0)
    distance = torch.where(linked[root] > 0, 1, 2)
    distance[root] = 0
    inwards = distance[:, None] < distance
    itself = torch.eye(size, dtype=torch.bool)
    return torch.stack([gathered * itself, gathered * ~(itself | inwards), gathered * inwards])


class STGCN(nn.Module):
    """A stack of graph convolutions and temporal convolutions over 9 frames.

    The output is averaged over frames and joints. Dropout, which the published training code uses,
    is omitted. Past the end of a motion, the convolutions read zeros, so that features do not
    depend on the other motions in a batch. In the published evaluations, all motions have 60
    frames, and the last frame of shorter clips is repeated. `widths` and `strides` contain one
    number per block.
    """

    def __init__(
        self,
        parents: Sequence[int],
        num_actions: int,
        widths: Sequence[int],
        strides: Sequence[int],
        channels: int = 3,
    ):
        super().__init__()
        self.register_buffer("A", adjacency(parents))
        self.A: Tensor
        self.data_bn = nn.BatchNorm1d(channels * len(parents))
        self.st_gcn_networks = nn.ModuleList()
        for before, width, stride in zip([channels, *widths[:-1]], widths, strides, strict=True):
            self.st_gcn_networks.append(
                _Block(before, width, len(self.A), stride, len(self.st_gcn_networks) > 0)
            )
        self.edge_importance = nn.ParameterList(
            [nn.Parameter(torch.ones_like(self.A)) for _ in widths]
        )
        self.fcn = nn.Conv2d(widths[-1], num_actions, 1)

    def forward(self, x: Tensor, mask: Tensor) -> Tensor:
        """Computes features (B, E) from motions (B, F, V, C) and their mask (B, F)."""
        x = self.data_bn(x.flatten(2).transpose(1, 2)).unflatten(1, x.shape[2:]).permute(0, 2, 3, 1)
        for block, importance in zip(self.st_gcn_networks, self.edge_importance, strict=True):
            x = block(x, self.A * importance, mask)
            mask = mask[:, :: block.stride]
        return x.mean(3).masked_fill(~mask[:, None], 0).sum(2) / mask.sum(1, keepdim=True)

    def logits(self, x: Tensor, mask: Tensor) -> Tensor:
        """Returns unnormalized log-probabilities (B, actions) for the same input as `forward`."""
        return self.fcn(self(x, mask)[..., None, None])[..., 0, 0]


class _Block(nn.Module):
    """A graph convolution followed by a temporal convolution, for inputs (B, C, F, V)."""

    def __init__(self, in_channels: int, width: int, partitions: int, stride: int, residual: bool):
        super().__init__()
        self.stride = stride
        self.gcn = nn.ModuleDict({"conv": nn.Conv2d(in_channels, width * partitions, 1)})
        over_time = nn.Conv2d(
            width, width, (TEMPORAL_KERNEL, 1), (stride, 1), (TEMPORAL_KERNEL // 2, 0)
        )
        self.tcn = nn.Sequential(nn.BatchNorm2d(width), nn.ReLU(), over_time, nn.BatchNorm2d(width))
        self.residual: nn.Module | None = None
        if residual:
            same = in_channels == width and stride == 1
            project = nn.Conv2d(in_channels, width, 1, (stride, 1))
            self.residual = nn.Identity() if same else nn.Sequential(project, nn.BatchNorm2d(width))

    def forward(self, x: Tensor, graph: Tensor, mask: Tensor) -> Tensor:
        y = self.gcn["conv"](x).unflatten(1, (len(graph), -1))
        normalize, activate, convolve, normalize_again = self.tcn
        y = activate(normalize(torch.einsum("bkcfv,kvw->bcfw", y, graph)))
        y = normalize_again(convolve(y.masked_fill(~mask[:, None, :, None], 0)))
        return torch.relu(y if self.residual is None else y + self.residual(x))


class UESTC(STGCN):
    """The classifier for the 40 actions of UESTC, used for the tables of ACTOR, MDM and MFM.

    It reads joint rotations.
    """

    def __init__(self):
        widths = (64,) * 4 + (128,) * 3 + (256,) * 3
        super().__init__(SMPL24.parents, 40, widths, (1, 1, 1, 1, 2, 1, 1, 2, 1, 1), channels=6)

    def forward(self, x: Tensor, mask: Tensor) -> Tensor:
        """Computes features (B, 256) from motions (B, F, 25 x 6). The root trajectory is ignored."""
        return super().forward(x.unflatten(-1, (25, 6))[:, :, :24], mask)


class Unconstrained(STGCN):
    """The classifier used in MDM's unconstrained evaluation (Raab et al. 2022, "MoDi"): 15 joints, 12 actions."""

    def __init__(self):
        super().__init__(UNCONSTRAINED_PARENTS, 12, (64, 64, 64, 128, 128, 256), (1, 1, 1, 2, 1, 2))

    def forward(self, x: Tensor, mask: Tensor) -> Tensor:
        """Computes features (B, 256) from joint positions (B, F, 24, 3) in meters, with y up.

        The network itself expects y to point down.
        """
        return self.published(
            x[:, :, list(UNCONSTRAINED_JOINTS)] * x.new_tensor([1.0, -1.0, -1.0]), mask
        )

    def published(self, x: Tensor, mask: Tensor) -> Tensor:
        """Computes features (B, 256) from joint positions (B, F, 15, 3).

        As in the reference motions, the y axis points down, and the pelvis has index 8.
        """
        return super().forward(x - x[:, :, 8:9], mask)


class JointSTGCN(STGCN):
    """A trainable classifier for any skeleton.

    It reads joint positions relative to the root in the first frame.
    """

    def forward(self, x: Tensor, mask: Tensor) -> Tensor:
        """Computes features (B, 256) from joint positions (B, F, J, 3) in meters, with mask (B, F)."""
        return super().forward(x - x[:, :1, :1], mask)
