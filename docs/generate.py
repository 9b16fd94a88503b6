"""Writes recipes.md and hyperparameters.md from the recipes: `python docs/generate.py`."""

from __future__ import annotations

import re
from collections.abc import Mapping
from itertools import takewhile
from pathlib import Path
from typing import Any, NamedTuple

from flame_mdm.config import EXPERIMENTS, recipes
from flame_mdm.hyperparameters import LABELS, values

HEAD = "<!-- Written by docs/generate.py; do not edit. -->\n"

# Recipes --------------------------------------------------------------------------------------------------------------


def head(name: str) -> tuple[str, str]:
    """What the head comment of a recipe says it is (paper, table, row), and its deviations."""
    lines = (EXPERIMENTS / f"{name}.yaml").read_text().splitlines()[1:]
    comment = " ".join(line.removeprefix("#").strip() for line in takewhile(lambda line: line.startswith("#"), lines))
    what, _, deviations = comment.partition("Deviations")
    return what.strip(), ("Deviations" + deviations if deviations else "")


def recipes_page() -> str:
    """All recipes with the paper, table and row they stand for."""
    page = f"""# Recipes

{HEAD}
One recipe a row of the papers' tables: `make train EXP=humanml3d/mdm`. "Those of mdm" are the deviations of the recipe
of that name in the same folder. A few hold for all recipes: a batch holds motions of about the same length, every
sample of a batch weighs the same, and checkpoints are chosen on validation clips.
"""
    folder = None
    for name in sorted(recipes(), key=lambda name: ("/" in name, name)):
        if name.rpartition("/")[0] != folder:
            folder = name.rpartition("/")[0]
            page += f"\n## {folder or 'First steps'}\n\n| recipe | paper, table, row | deviations |\n|---|---|---|\n"
        what, deviations = head(name)
        deviations = re.sub(r"^Deviations(:| from)\s*", lambda m: "" if m[1] == ":" else "from ", deviations)
        page += f"| `{name}` | {what} | {deviations} |\n"
    return page


# Hyper-parameters -----------------------------------------------------------------------------------------------------


class Table(NamedTuple):
    """Hyper-parameters that a paper gives: values by dotted key, by recipe; None = shown, but not in the paper."""

    title: str
    columns: Mapping[str, Mapping[str, Any]]


_FLAME = {
    "data.batch_size": None,
    "optimizer._target_": "AdamW",
    "optimizer.lr": 1e-4,
    "optimizer.weight_decay": 1e-4,
    "optimizer.betas": (0.9, 0.999),
    "process.num_train_timesteps": 1000,
    "process.schedule": "cosine",
    "process.timestep_sampling": "uniform",
    "features": 147,
    "denoiser.latent_dim": 768,
    "denoiser.ff_size": 2048,
    "denoiser.num_layers": 8,
    "denoiser.num_heads": 8,
    "denoiser.dropout": 0.1,
    "denoiser.max_frames": 471,
    "condition.max_tokens": 20,
    "task.cond_drop_prob": 0.25,
    "task.guidance_scale": 8.0,
    "ema.update_every_n_steps": 10,
    "ema.decay": 0.99,
}
_MDM = {
    "optimizer.lr": 1e-4,
    "data.batch_size": 64,
    "process.num_train_timesteps": 1000,
    "process.schedule": "cosine",
    "process.prediction": "x0",
    "process.variance": "fixed_small",
    "denoiser.latent_dim": 512,
}
_TRANSFORMER = {
    "denoiser.ff_size": 1024,
    "denoiser.num_layers": 8,
    "denoiser.num_heads": 4,
    "denoiser.dropout": 0.1,
}
_TEXT = {"trainer.max_steps": 500_000, "task.cond_drop_prob": 0.1, "task.guidance_scale": 2.5}
_GEOMETRIC = {"losses.joints": 1.0, "losses.velocity": 1.0, "losses.foot_contact": 1.0}
_MFM = {
    "optimizer._target_": "AdamW",
    "optimizer.lr": 1e-4,
    "data.batch_size": 256,
    "trainer.max_steps": None,
    "denoiser.latent_dim": None,
    "denoiser.ff_size": None,
    "denoiser.num_layers": 8,
    "denoiser.num_heads": 4,
    "task.sampler": "euler",
    "task.num_inference_steps": 10,
}
_MOTION_CLIP = {
    "data.batch_size": None,
    "trainer.max_steps": None,
    "optimizer._target_": "AdamW",
    "optimizer.lr": 1e-4,
    "optimizer.weight_decay": 1e-4,
    "optimizer.betas": (0.9, 0.999),
    "features": 147,
    "task.network.latent_dim": 512,
    "task.network.ff_size": 768,
    "task.network.num_layers": 6,
    "task.network.num_heads": 8,
    "task.network.dropout": 0.1,
    "task.network.max_frames": 471,
    "task.network.embedding_dim": 512,
}
_MFM_TEXT = {"task.cond_drop_prob": 0.1, "task.guidance_scale": 2.5, "parameters": 17.9}


def _steps(total: int) -> dict[str, Any]:
    return {"process.num_train_timesteps": total, "task.num_inference_steps": total}


def _losses(joints: float, velocity: float, foot_contact: float) -> dict[str, Any]:
    return {"losses.joints": joints, "losses.velocity": velocity, "losses.foot_contact": foot_contact}


def _ablation(length_token: bool, cross_attention: bool, freeze: bool) -> dict[str, Any]:
    return {
        "denoiser.length_token": length_token,
        "denoiser.cross_attention": cross_attention,
        "condition.freeze": freeze,
    }


TABLES = (
    Table(
        'FLAME (Kim et al., AAAI 2023, tables 6 and 7, "Training Details")',
        {
            "humanml3d/flame": _FLAME | {"trainer.max_steps": 600_000},
            "babel/flame": _FLAME | {"trainer.max_steps": 1_000_000},
            "kit/flame": _FLAME
            | {
                "trainer.max_steps": 200_000,
                "features": 64,
                "denoiser.latent_dim": 512,
                "denoiser.max_frames": 1400,
            },
        },
    ),
    Table(
        "FLAME, ablation (table 4)",
        {
            "humanml3d/flame_self_attention": _ablation(False, False, False),
            "humanml3d/flame_length_token": _ablation(True, False, False),
            "humanml3d/flame_cross_attention": _ablation(True, True, False),
            "humanml3d/flame": _ablation(True, True, True),
        },
    ),
    Table(
        "Motion-CLIP (Kim et al., AAAI 2023, table 8)",
        {"motion_clip/humanml3d_smpl": _MOTION_CLIP, "motion_clip/babel": _MOTION_CLIP},
    ),
    Table(
        "MDM, text-to-motion (Tevet et al., ICLR 2023, section 4.1, appendix C, table 8)",
        {
            "humanml3d/mdm": _MDM | _TRANSFORMER | _TEXT | {"parameters": 17.88},
            "humanml3d/mdm_decoder": _MDM | _TRANSFORMER | _TEXT | {"parameters": 26.29},
            "humanml3d/mdm_decoder_token": _MDM | _TRANSFORMER | _TEXT | {"parameters": 26.29},
            "humanml3d/mdm_unet": _MDM | _TEXT | {"parameters": 23.47},
            "humanml3d/mdm_gru": _MDM | _TEXT | {"denoiser.num_layers": 2, "parameters": 4.47},
            "humanml3d/mdm_sentence_bert": _MDM | _TRANSFORMER | _TEXT,
            "kit/mdm": _MDM | _TRANSFORMER | _TEXT,
        },
    ),
    Table(
        "MDM, diffusion steps (table 6)",
        {
            "humanml3d/mdm_10_steps": _steps(10),
            "humanml3d/mdm_100_steps": _steps(100),
            "humanml3d/mdm_500_steps": _steps(500),
            "humanml3d/mdm": _steps(1000),
        },
    ),
    Table(
        "MDM, action-to-motion and unconstrained (sections 4.2 and 5.2, appendix C)",
        {
            "humanact12/mdm": _MDM | _TRANSFORMER | _GEOMETRIC | {"trainer.max_steps": 750_000},
            "humanact12/mdm_unconstrained": _MDM | _TRANSFORMER,
            "uestc/mdm": _MDM | _TRANSFORMER | _GEOMETRIC | {"trainer.max_steps": 2_000_000},
            "uestc/mdm_no_foot_contact": _MDM | _TRANSFORMER | _losses(1, 1, 0) | {"trainer.max_steps": 2_000_000},
        },
    ),
    Table(
        "MDM, geometric losses (table 7)",
        {
            "humanact12/mdm": _losses(1, 1, 1),
            "humanact12/mdm_no_foot_contact": _losses(1, 1, 0),
            "humanact12/mdm_no_geometric": _losses(0, 0, 0),
            "humanact12/mdm_foot_contact_only": _losses(0, 0, 1),
            "humanact12/mdm_velocity_only": _losses(0, 1, 0),
            "humanact12/mdm_pose_only": _losses(1, 0, 0),
        },
    ),
    Table(
        "Motion Flow Matching (Hu et al., 2023, sections 3.1, 4.1 and 8.1, tables 1, 2, 4 and 5)",
        {
            "humanml3d/mfm": _MFM | _MFM_TEXT,
            "humanml3d/mfm_t5": _MFM | {"task.cond_drop_prob": 0.1},
            "kit/mfm": _MFM | _MFM_TEXT,
            "kit/mfm_50_steps": _MFM | _MFM_TEXT | {"task.num_inference_steps": 50},
            "humanact12/mfm": _MFM,
        },
    ),
)

DEVIATIONS = {
    ("humanml3d/mdm_unet", "parameters"): "no code is public; the widths are chosen to come close",
}
"""Where a recipe leaves what the paper says, by (recipe, key), and why."""


def same(ours: Any, papers: Any) -> bool:
    """Whether a value is the paper's, as far as the paper's digits go."""
    if isinstance(papers, float) and isinstance(ours, float):
        digits = len(f"{papers}".partition(".")[2]) if papers > 1 else 12
        return round(ours, digits) == papers
    return ours == papers


def hyperparameters_page() -> str:
    """The papers' tables of hyper-parameters, filled from the recipes."""
    page = f"""# Hyper-parameters

{HEAD}
What the recipes say, in the order of the papers' tables. In bold: the paper gives this value, too. Where the two
differ, both stand there. The rest is what the papers leave open, mostly the value of the authors' code; "–": there is
no such thing.
"""
    for table in TABLES:
        columns = {name: values(name) for name in table.columns}
        rows = [key for key in LABELS if any(key in papers for papers in table.columns.values())]
        page += f"\n## {table.title}\n\n| | {' | '.join(f'`{name}`' for name in columns)} |\n"
        page += f"|---|{'---|' * len(columns)}\n"
        for key in rows:
            cells = [_cell(ours.get(key), table.columns[name].get(key)) for name, ours in columns.items()]
            page += f"| {LABELS[key]} | {' | '.join(cells)} |\n"
    page += "\n## Where a recipe leaves its paper\n\n"
    for (name, key), reason in DEVIATIONS.items():
        page += f"- `{name}`, {LABELS[key]}: {reason}.\n"
    return page + "\nWhat the tables of the papers do not show stands in [recipes.md](recipes.md).\n"


def _cell(ours: Any, papers: Any) -> str:
    if papers is None:
        return _text(ours)
    return f"**{_text(papers)}**" if same(ours, papers) else f"{_text(ours)} (paper: {_text(papers)})"


def _text(value: Any) -> str:
    if value is None:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, list | tuple):
        return ", ".join(_text(item) for item in value)
    if isinstance(value, int):
        return f"{value:,}".replace(",", " ")
    return f"{value:.4g}" if isinstance(value, float) else str(value)


PAGES = {"recipes.md": recipes_page, "hyperparameters.md": hyperparameters_page}

if __name__ == "__main__":
    for name, write in PAGES.items():
        (Path(__file__).parent / name).write_text(write())
