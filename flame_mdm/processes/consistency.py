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
    teacher_steps: int = 1,
    index: Tensor,
    noise: Tensor,
    auxiliary: Auxiliary,
) -> dict[str, Tensor]:
    """Returns the losses (B,) of f at x_t against f after steps of the teacher: "consistency", auxiliary, "loss".

    The steps are those of DDIM with eta = 0, which for a flow is Euler's. After the last time comes the data, where f
    is the teacher's estimate.

    Args:
        process: of student and teacher; predicts the clean motion or the velocity.
        student: computes f at x_t.
        follower: computes f after the step, the target, without gradient: the student or an average of its weights.
        teacher: guided.
        x, mask, cond: motions (B, F, D), their real frames (B, F), and conditions.
        times: (N * teacher_steps,), of the teacher, from pure noise on; see `Process.grid`. The student learns at every
            `teacher_steps`-th of them.
        teacher_steps: number of steps from one time of the student to the next.
        index: (B,) int64, from 0 to N - 1, the number of the student's time of each motion.
        noise: (B, F, D), standard normal.
        auxiliary: geometric losses of the estimate against the target.
    """
    first = index * teacher_steps
    t = times[first]
    x_t = process.corrupt(x, noise, t)
    zeros, ones = torch.zeros_like(x), torch.ones_like(x)
    with torch.no_grad():
        nearer, now = x_t, t
        for step in range(1, teacher_steps + 1):
            guided = process.clean(teacher, nearer, now, mask, cond)
            left = (nearer - process.corrupt(guided, zeros, now)) / process.corrupt(zeros, ones, now)
            now = times[(first + step).clamp(max=len(times) - 1)]
            nearer = process.corrupt(guided, left, now)
        is_last = first + teacher_steps == len(times)
        target = torch.where(is_last[:, None, None], guided, process.clean(follower, nearer, now, mask, cond))
    estimate = process.clean(student, x_t, t, mask, cond)
    terms = {"consistency": masked_mse(estimate, target, mask)} | auxiliary(estimate, target, mask)
    return terms | {"loss": torch.stack(list(terms.values())).sum(0)}
