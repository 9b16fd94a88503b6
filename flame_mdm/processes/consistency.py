"""Consistency distillation: a student learns to reach in one call what its teacher reaches in many small steps.

f(x_t, t) is the clean estimate of a network at time t. Along a path of the teacher, f should be the same at all times
(Song et al. 2023, "Consistency Models"). The teacher's steps are guided, so that the student needs no guidance (Luo et
al. 2023, "Latent Consistency Models"; Dai et al. 2024, "MotionLCM").
"""

import torch
from torch import Tensor

from flame_mdm.batch import Condition, Denoise
from flame_mdm.losses import masked_mse
from flame_mdm.processes import Auxiliary, Process


def consistency_terms(
    process: Process,
    student: Denoise,
    follower: Denoise,
    teacher: Denoise,
    x: Tensor,
    mask: Tensor,
    cond: Condition,
    *,
    times: Tensor,
    index: Tensor,
    noise: Tensor,
    auxiliary: Auxiliary,
) -> dict[str, Tensor]:
    """Returns the losses (B,) of f at x_t against f after one step of the teacher: "consistency", auxiliary, "loss".

    The step is that of DDIM with eta = 0, for a flow Euler's. After the grid comes the data, the teacher's estimate.

    Args:
        process: of student and teacher; predicts the clean motion or the velocity.
        follower: computes f after the step, the target, without gradient: the student or an average of its weights.
        teacher: guided.
        times: (N,), from pure noise on; see `Process.grid`.
        index: (B,) int64, the number of the time of each motion.
        auxiliary: geometric losses of the estimate against the target.
    """
    is_last = index == len(times) - 1
    t, end = times[index], times[(index + 1).clamp(max=len(times) - 1)]
    x_t = process.corrupt(x, noise, t)
    with torch.no_grad():
        guided = process.clean(teacher, x_t, t, mask, cond)
        zero, one = torch.zeros_like(x), torch.ones_like(x)
        left = (x_t - process.corrupt(guided, zero, t)) / process.corrupt(zero, one, t)
        nearer = process.corrupt(guided, left, end)
        target = torch.where(
            is_last[:, None, None], guided, process.clean(follower, nearer, end, mask, cond)
        )
    estimate = process.clean(student, x_t, t, mask, cond)
    terms = {"consistency": masked_mse(estimate, target, mask)} | auxiliary(estimate, target, mask)
    return terms | {"loss": torch.stack(list(terms.values())).sum(0)}
