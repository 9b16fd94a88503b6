"""Small models with random weights for recorded results, and summaries of what they sample."""

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import torch

from flame_mdm.config import compose, instantiate
from flame_mdm.data.standing import standing
from flame_mdm.data.synthetic import prompts
from flame_mdm.formats.motion import Motion
from flame_mdm.generator import MotionGenerator
from flame_mdm.sampling.reading import with_features
from flame_mdm.sampling.targets import Targets
from support.recorded import some_bodies
from support.runs import TINY, TINY_DIP, untrained

FEW: dict[str, Any] = {"num_inference_steps": 2}
WALK, WAVE = "a person walks forward", "a person waves"


# Models ----------------------------------------------------------------------------------------


def facts() -> dict[str, Any]:
    texts = [text for text, _ in prompts()]
    return {
        "actions": list(dict.fromkeys(str(stated["action"]) for _, stated in prompts())),
        "verbs": ["walks", "sits", "waves"],
        "vocabulary": sorted({word for text in texts for word in text.lower().split()} | {"sits"}),
        "captions": texts,
    }


def with_usual_motions(model: MotionGenerator, std: float = 0.05) -> MotionGenerator:
    """Changes a model with random weights so that its motions are almost a person who stands."""
    representation = model.representation
    still = torch.from_numpy(standing(representation, 10).features[0])
    numbers = torch.rand(len(still), generator=torch.Generator().manual_seed(3))
    representation.mean.copy_(still)
    representation.std.copy_(std * (0.5 + numbers))
    return model


@cache
def diffusion() -> MotionGenerator:
    model = with_usual_motions(untrained(TINY, 60))
    model.add_facts(facts())
    return model


@cache
def flow() -> MotionGenerator:
    """A model of flow matching; its captions may describe several actions."""
    words = [word for word in TINY if "num_train_timesteps" not in word]
    model = untrained([*words, "process=flow_matching", "task.sampler=euler"], 44)
    model.add_facts({**facts(), "verbs": []})
    return with_usual_motions(model)


@cache
def dip() -> MotionGenerator:
    model = with_usual_motions(untrained(TINY_DIP, 40, "synthetic/dip"), 0.02)
    model.add_facts(facts())
    return model


@cache
def labeled() -> MotionGenerator:
    words = [word for word in TINY if not word.startswith("condition")]
    config = compose("quickstart", [*words, "condition=action", "condition.features=16"])
    torch.manual_seed(1)
    names = ("walk", "kick", "bow")
    model = MotionGenerator.build(config, instantiate(config["representation"]), actions=names)
    model.facts |= {"max_frames": 30, "dataset": "synthetic", "fingerprint": "f00d"}
    return with_usual_motions(model.eval())


MODELS: dict[str, Callable[[], MotionGenerator]] = {
    "diffusion": diffusion, "flow": flow, "dip": dip, "labeled": labeled,
}  # fmt: skip


@cache
def walk() -> Motion:
    """A walk of 37 frames with features, away from the origin."""
    joints = next(iter(some_bodies(1, 20.0, 4).values()))[:37] * 0.97
    motion = Motion(joints.astype(np.float32), 20.0, text="a walk", id="walk")
    return with_features(diffusion().representation, motion)


def shown(motion: Motion) -> Any:
    features = motion.features
    return (
        motion.text, motion.id, motion.fps, motion.parts, motion.degenerate, motion.representation,
        motion.cleanup, motion.notes, motion.joints.astype(np.float64), features,
    )  # fmt: skip


def shown_targets(targets: Targets | None) -> Any:
    if targets is None:
        return None
    columns = vars(targets.positions)
    rows = sorted(zip(*(columns[key].tolist() for key in columns), strict=True))
    return (np.array(rows), len(rows), [(frame, x) for frame, x in targets.poses])
