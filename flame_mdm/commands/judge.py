"""`flame-mdm judge MOTION|FOLDER text="..."`: judges whether motions show what a sentence states."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from flame_mdm.commands import (
    BodySettings,
    FileSettings,
    above_zero,
    existing,
    finish,
    read_motions,
)
from flame_mdm.config.options import option, required
from flame_mdm.errors import UserError, say, shortened

if TYPE_CHECKING:
    from flame_mdm.formats.motion import Motion
    from flame_mdm.sampling.referee.judging import Judgment


@dataclass(frozen=True, kw_only=True)
class JudgeSettings(BodySettings, FileSettings):
    """usage: flame-mdm judge MOTION text="a person waves with the left hand" [OUT.html] [fps=20] [unit=0.01] [up=z]
           flame-mdm judge FOLDER [OUT.html] [clips=24]

    Reads the claims in a sentence, for example about side, count, direction, posture or order, and
    checks each of them by measuring the motion. A verdict is yes, no or cannot tell, with the
    joint, the measured number and the time. Without text=, motions are judged by their own texts.
    Writes a player whose timeline marks the evidence. Exits with code 3 if a claim is false. See
    docs/referee.md.
    """

    OBJECTS: ClassVar = ("motion", "out")
    motion: str = required(
        "a motion file with SMPL's 22 joints, or a folder of motion files", existing
    )
    text: str | None = option(
        None, "sentence by which the motions are judged; default: the text in each motion file"
    )
    out: str | None = option(None, "HTML file; default: runs/judge/<name>.html")
    clips: int = option(
        24, "maximum number of motions in the player, which shows the worst ones", above_zero
    )


def main(settings: JudgeSettings) -> None:
    from flame_mdm.sampling.referee.judging import judge
    from flame_mdm.visualize import write_player

    body = settings.read_body()
    failures: list[str] = []
    name, total, motions = read_motions(settings.motion, settings, failures)
    judged: list[tuple[Motion, Judgment]] = []
    for motion in motions:
        try:
            judgment = judge(motion, settings.text)
        except UserError as error:
            if total == 1:
                raise UserError(f"{settings.motion}: {error}") from error
            failures.append(f"{motion.id}: {error}")
            continue
        judged.append((replace(motion, text=judgment.text), judgment))
        _report(motion.id, judgment)
    if not judged:
        finish(failures, total, "judged")
        raise UserError(f"{settings.motion}: no motion to judge. Specify a motion file or a folder")

    answers = Counter(verdict.answer for _, judgment in judged for verdict in judgment.verdicts)
    say(
        f"{name}: in {len(judged)} motions, {answers['yes']} claims are true, {answers['no']} are "
        f"false, and {answers['cannot tell']} cannot be decided"
    )
    judged.sort(key=lambda pair: pair[1].true - pair[1].decided)
    shown = judged[: settings.clips]
    marks = [
        [
            mark
            for verdict in judgment.verdicts
            for mark in verdict.marks(motion.fps, len(motion.joints))
        ]
        for motion, judgment in shown
    ]
    out = Path(settings.out or Path("runs") / "judge" / f"{name}.html")
    write_player(
        out, [motion for motion, _ in shown], f"Verdicts on {name}", marks=marks, body=body
    )
    say(f"player: {out}")
    finish(failures, total, "judged")
    if answers["no"]:
        raise SystemExit(3)


def _report(name: str, judgment: Judgment) -> None:
    say(f"{name}: '{shortened(judgment.text, 80)}'")
    say(*(f"  {verdict}" for verdict in judgment.verdicts))
    if not judgment.verdicts:
        say("  the text contains no claim that can be checked")
