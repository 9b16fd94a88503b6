"""Evaluation of models that continue frames: the frames come from the real clips, and are not measured."""

from pathlib import Path

import numpy as np
import pytest
import torch
from support.runs import TINY_DIP, untrained

from evaluators.evaluation import Evaluation
from evaluators.protocol import Protocol, load_protocol, open_protocol
from evaluators.sources import Generator, real_motions
from flame_mdm.config import compose, instantiate
from flame_mdm.data.crops import Clips
from flame_mdm.generator import MotionGenerator
from flame_mdm.records import Value

CONTEXT, FRAMES = 10, 40


@pytest.fixture(scope="module")
def model() -> MotionGenerator:
    return untrained(TINY_DIP, FRAMES, "synthetic/dip")


@pytest.fixture(scope="module")
def clips(model, data_root: Path) -> Clips:
    config = compose("synthetic/dip", ["data.source.clips=120", f"data_root={data_root}"])
    data = instantiate(config["data"], representation=model.representation, seed=0)
    data.prepare_data()
    data.setup("test")
    return data.test


@pytest.fixture(scope="module")
def protocol(model, clips) -> Protocol:
    opened, changed = open_protocol("synthetic", clips, model.representation, model)
    assert changed == {"context_frames": CONTEXT}
    return opened


def test_the_frames_before_the_measured_ones_are_the_context(protocol, clips, model, subtests):
    rows = protocol.rows(clips, 0, 0)
    assert rows
    for row in rows:
        with subtests.test(clip=row.id):
            assert (len(row.context), len(row.frames)) == (CONTEXT, FRAMES - CONTEXT)
            assert row.context[-1] + 1 == row.frames[0]
    for purpose in ("real", "training"):
        with subtests.test(purpose=purpose):
            assert all(
                len(row.frames) == FRAMES - CONTEXT
                for row in protocol.rows(clips, 0, 0, purpose=purpose)
            )
    ordinary = load_protocol("synthetic", model.representation)
    assert all(
        len(row.frames) == FRAMES and not len(row.context) for row in ordinary.rows(clips, 0, 0)
    )


def test_expected_values_of_whole_motions_are_not_those_of_cut_ones(
    protocol, clips, model, subtests
):
    bounds = {"expected": {"synthetic": {"foot_skating": [-1.0, 0.0]}}}
    cut = protocol.model_copy(update=bounds)
    whole = cut.model_copy(update={"context": "start"})
    values = {"foot_skating": Value(mean=0.5, ci=None, replications=1, n=1)}
    for measured, count in ((cut, 0), (whole, 1)):
        with subtests.test(measured=measured, count=count):
            evaluation = Evaluation(measured, clips, None, model.representation)
            assert len(evaluation._unexpected(values)) == count
    lines = Evaluation(cut, clips, None, model.representation)._conditions()
    assert any("does not measure the first frames" in line for line in lines)


def test_the_authors_begin_in_one_of_the_first_frames_and_measure_the_whole_length(protocol, clips):
    authors = protocol.model_copy(update={"context": "start"})
    rows = [row for replication in range(20) for row in authors.rows(clips, 0, replication)]
    firsts = [int(row.context[0]) for row in rows]
    assert set(firsts) == set(range(5))
    assert all((np.diff(row.context) == 1).all() and len(row.context) == CONTEXT for row in rows)
    assert all(len(row.frames) == FRAMES for row in rows)


def test_the_model_continues_the_real_frames_of_its_clips(protocol, clips, model):
    rows = protocol.rows(clips, 0, 0)[:3]
    seen: list[torch.Tensor] = []
    hook = model.denoiser.register_forward_hook(lambda _, inputs, __: seen.append(inputs[3].prefix))
    source = Generator(model, protocol, clips, model.sampler_options, {}, 0, 4, progress=False)
    samples = source("rep_0", rows, 0)
    hook.remove()
    assert [motion.shape for motion in samples.features] == [(FRAMES - CONTEXT, 263)] * 3
    whole = [np.concatenate([row.context, row.frames]) for row in rows]
    for prefix, row, frames in zip(seen[0], rows, whole, strict=False):
        real = clips.store.motion(row.clip)[frames][:CONTEXT]
        np.testing.assert_allclose(
            model.representation.denormalize(prefix).numpy(), real, atol=1e-4
        )
    assert [len(motion) for motion in real_motions(clips, rows)] == [FRAMES - CONTEXT] * 3
