"""A perfect denoiser reproduces a motion whose root travels far, sampled as each recipe says, in at most 50 steps."""

from __future__ import annotations

import pytest
import torch
from support.analytic import oracle, sample
from support.fixtures import recipe
from torch import Tensor

from flame_mdm.batch import Edit
from flame_mdm.config import instantiate, recipes
from flame_mdm.representations import Representation
from flame_mdm.sampling.motion_request import METHODS
from flame_mdm.seeds import normal

METERS, FRAMES, MAX_STEPS = 10.0, 60, 50
GENERATION = [
    name for name in recipes() if "process" in recipe(name) and "distillation" not in recipe(name)
]


def family(name: str) -> str:
    """Options of a recipe that change how its motions are sampled."""
    config, task = recipe(name), recipe(name)["task"]
    return repr(
        [config["process"], config["representation"], task["sampler"], task["num_inference_steps"]]
    )


FAMILIES = {family(name): name for name in reversed(GENERATION)}.values()
CLAMPED = {"babel/flame_code", "humanml3d/flame_code"}
UNCLAMPED = sorted(set(FAMILIES) - CLAMPED)


def traveller(representation: Representation) -> Tensor:
    """Normalized features (1, F, D) float64 of a stiff body whose root moves `METERS` at constant speed."""
    raw = torch.zeros(FRAMES + 1, 75)
    raw[:, 0] = METERS * torch.arange(FRAMES + 1) / FRAMES
    raw[:, 2] = 0.9
    if representation.name.startswith(("smpl", "rot6d", "motion272")):
        features = representation.encode(raw)
    else:
        skeleton = representation.skeleton
        bones = 0.3 * torch.tensor(skeleton.raw_offsets, dtype=torch.float32).expand(
            len(raw), -1, -1
        )
        features = representation.encode(skeleton.assemble(bones, raw[:, [0, 2, 1]]))
        # Real velocities have a std this small, so some normalized features exceed 1.
        representation.std.fill_(0.05)
    return representation.normalize(features.double())[None]


def root_path(name: str, method: str | None = None) -> tuple[Tensor, Tensor]:
    """The root (F, 3) of the traveller, and of the oracle's sample, as the recipe has it, or edited by a method."""
    config = recipe(name)
    representation = instantiate(config["representation"]).double()
    process, x = instantiate(config["process"]), traveller(representation)
    keep = torch.ones_like(x, dtype=torch.bool)
    keep[:, FRAMES // 4 : 3 * FRAMES // 4] = False
    edit = None if method is None else Edit(x, keep, **METHODS[method])

    def noise(draw: int) -> Tensor:
        return normal(torch.tensor([draw]), *x.shape[1:]).double()

    sampler, steps = config["task"]["sampler"], config["task"]["num_inference_steps"]
    how = {
        "sampler": sampler,
        "num_inference_steps": min(steps, MAX_STEPS) if isinstance(steps, int) else steps,
    }
    sampled = sample(process, oracle(process, x, noise(0)), noise, edit=edit, **how)
    real, ours = (representation.to_joints(motion)[0, :, 0] for motion in (x, sampled))
    return real, ours


def longest_step(root: Tensor) -> float:
    return root.diff(dim=0).norm(dim=-1).max().item()


@pytest.mark.parametrize("name", UNCLAMPED)
def test_an_oracle_travels_as_far_as_the_motion_and_in_betweening_does_not_teleport(name, subtests):
    real, ours = root_path(name)
    # Some features have a frame less, or scale the body
    assert (real[-1] - real[0]).norm() > METERS - 0.2
    torch.testing.assert_close(ours, real, rtol=0, atol=0.02)
    modes = instantiate(recipe(name)["process"]).edit_modes
    for method in [method for method, how in METHODS.items() if how["mode"] in modes]:
        with subtests.test(method=method):
            _, between = root_path(name, method)
            torch.testing.assert_close(between[-1], real[-1], rtol=0, atol=0.02)
            assert longest_step(between) < 2 * longest_step(real)


@pytest.mark.parametrize("name", sorted(CLAMPED))
def test_the_clamp_of_the_authors_code_stops_the_root_and_teleports(name):
    assert {name for name in GENERATION if recipe(name)["process"].get("clip_x0")} == CLAMPED
    real, ours = root_path(name)
    assert (ours[-1] - real[-1]).norm() == pytest.approx(METERS - 1, abs=1e-3)
    _, between = root_path(name, "flame")
    assert longest_step(between) > 1
