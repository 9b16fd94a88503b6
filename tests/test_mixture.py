"""Several data sets as one, with the licenses of their motions; balanced folders."""

import json
from pathlib import Path

import numpy as np
import pytest
from support.stores import OwnClips, clip

from flame_mdm.__main__ import main
from flame_mdm.checkpoints.model_files import read_checkpoint
from flame_mdm.data.bandai import Bandai
from flame_mdm.data.cmu import CMU
from flame_mdm.data.folder import MOST_COPIES, Folder
from flame_mdm.data.mixture import Mixture
from flame_mdm.data.store import write_store
from flame_mdm.data.synthetic import Synthetic
from flame_mdm.errors import UserError
from flame_mdm.representations.humanml import HumanML

WALK = next(c for c in Synthetic(clips=30).clips(20.0) if c.attributes["action"] == "walk").motion
CAPTIONS = """id,text,action,split,license
one,a person walks,walk,train,MIT
two,someone strolls,walk,train,CC0
three,a person walks,walk,test,MIT
four,she dances with her left arm up,dance,train,CMU
"""


@pytest.fixture
def people(tmp_path: Path) -> Path:
    """A folder of four motions, two of which are training clips of a walk and one of a dance."""
    folder = tmp_path / "people"
    folder.mkdir()
    for name in ("one", "two", "three", "four"):
        np.savez(folder / f"{name}.npz", joints=WALK, fps=20)
    (folder / "captions.csv").write_text(CAPTIONS)
    return folder


def mixture(people: Path, **options) -> Mixture:
    return Mixture(
        {"synthetic": Synthetic(clips=5), "people": Folder(str(people), mirror=True)}, **options
    )


def test_a_store_of_a_mixture_has_all_clips_with_their_licenses(people: Path, tmp_path: Path):
    source = mixture(people)
    store = write_store(tmp_path / "store", source, HumanML())
    assert len(store.clips) == source.count() == 5 + 4 + 3

    licenses = {clip.id: clip.license for clip in store.clips}
    assert licenses["synthetic_0_000000"] == "MIT"
    assert licenses["two"] == "CC0"
    assert licenses["Mfour"] == "CMU"

    actions = store.info["actions"]
    assert {actions[clip.action] for clip in store.clips if clip.id in ("one", "four")} == {
        "walk",
        "dance",
    }
    assert len(set(actions)) == len(actions)


def test_minutes_and_actions_are_counted_by_license(people: Path, tmp_path: Path):
    source = Folder(str(people), mirror=True, balance=8)
    licenses = write_store(tmp_path / "store", source, HumanML()).licenses()
    minutes = round(2 * (len(WALK) - 1) / 20 / 60, 1)
    assert licenses[0] == {"license": "CC0", "clips": 2, "minutes": minutes, "actions": ["walk"]}
    assert [row["license"] for row in licenses] == ["CC0", "CMU", "MIT"]
    assert licenses[2]["clips"] == 3, "a test clip, and a training clip with its mirror image"


def test_the_license_of_a_row_counts_more_than_the_license_of_its_data_set(people: Path):
    (people / "captions.csv").write_text(CAPTIONS.replace("train,MIT", "train,"))
    source = Mixture({"people": Folder(str(people), license="CC-BY-4.0")})
    licenses = {clip.id: clip.license for clip in source.clips(20.0)}
    assert licenses == {"one": "CC-BY-4.0", "two": "CC0", "three": "MIT", "four": "CMU"}


def test_licenses_and_files_of_nested_mixtures_are_checked(people: Path):
    inner = Mixture({"people": Folder(str(people), license="CC-BY-4.0")}, use="research")
    outer = Mixture({"synthetic": Synthetic(clips=5), "others": inner}, use="research")
    assert outer.licenses() == {"MIT", "CC0", "CMU"}
    assert outer.count() == 5 + 4
    lines = [line for line in outer.check(20.0) if "clips can be prepared" in line]
    assert lines[0].startswith("synthetic: 5 clips")
    assert lines[1].endswith("4 clips can be prepared (motions: 3 train, 0 val, 1 test)")
    (people / "captions.csv").write_text(CAPTIONS.replace("CMU", "CC-BY-NC-4.0"))
    inner = Mixture({"people": Folder(str(people))}, use="research")
    outer = Mixture({"others": inner})
    assert outer.use == "any"
    for call in (outer.count, lambda: outer.check(20.0), lambda: next(outer.clips(20.0))):
        with pytest.raises(UserError, match=r"others contains motions with license CC-BY-NC-4\.0"):
            call()


def test_stores_without_licenses_are_written_as_before(tmp_path: Path):
    store = write_store(tmp_path / "store", Synthetic(clips=3), HumanML())
    lines = (store.folder / "clips.jsonl").read_text().splitlines()
    assert all("license" not in json.loads(line) for line in lines)


@pytest.mark.parametrize(
    ("license", "words"), [("CC-BY-NC-4.0", "license CC-BY-NC-4.0"), ("", "an unknown license")]
)
def test_a_license_that_forbids_the_use_is_refused_before_motions_are_read(
    people: Path, license: str, words: str
):
    (people / "captions.csv").write_text(CAPTIONS.replace("CC0", license))
    with pytest.raises(UserError, match=f"parts.people contains motions with {words}"):
        mixture(people).count()
    assert mixture(people, use="research").count() == 12


def test_few_clips_of_an_action_are_repeated(people: Path):
    source = Folder(str(people), mirror=True, balance=8)
    clips = list(source.clips(20.0))
    assert len(clips) == source.count()
    actions = [
        source.actions[clip.action]
        for clip in clips
        if clip.split == "train" and clip.action is not None
    ]
    assert (actions.count("walk"), actions.count("dance")) == (8, 8)
    assert len({clip.id for clip in clips}) == len(clips)
    assert sum(clip.split == "test" for clip in clips) == 1


def test_copies_share_their_frames_and_are_limited(people: Path, tmp_path: Path):
    source = Folder(str(people), balance=1000)
    store = write_store(tmp_path / "store", source, HumanML())
    copies = [clip for clip in store.clips if clip.id.startswith("four")]
    assert len(copies) == MOST_COPIES
    assert len({clip.start for clip in copies}) == 1


def test_captions_of_some_actions_get_a_word_in_front(people: Path):
    source = Folder(str(people), mirror=True, prefixes={"captured": ["walk"]})
    captions = {clip.id: clip.captions for clip in source.clips(20.0)}
    assert captions["one"] == ["captured, a person walks"]
    assert captions["four"] == ["she dances with her left arm up"]
    assert captions["Mfour"] == ["she dances with her right arm up"]
    assert source.options["prefixes"] == {"walk": "captured"}
    with pytest.raises(UserError, match=r"prefixes: no motion has the action fly.*captions.csv"):
        Folder(str(people), prefixes={"captured": ["walk", "fly"]}).count()


def test_a_recipe_of_a_mixture_is_checked_at_the_command_line():
    with pytest.raises(UserError, match="Use any or research"):
        Mixture({"synthetic": Synthetic(clips=1)}, use="sale")  # pyright: ignore[reportArgumentType]
    with pytest.raises(UserError, match="at least one data set"):
        Mixture({})


def test_a_mixture_shares_the_captions_of_clips_whose_license_allows_any_use(people: Path):
    source = mixture(people)
    shared = {license: source.may_share_captions(license) for license in ("MIT", "CMU", "", "NC")}
    assert shared == {"MIT": True, "CMU": True, "": False, "NC": False}


def test_the_version_of_a_mixture_follows_the_versions_of_its_parts():
    """A store of a mixture must be prepared again if one of its data sets is read in another way."""
    versions = Synthetic.version, Folder.version, CMU.version, Bandai.version
    message = "increase Mixture.version, then these numbers"
    assert (versions, Mixture.version) == ((1, 2, 2, 1), 1), message


@pytest.mark.parametrize(
    ("balance", "walks", "dances"), [(7, 8, 8), (9, 8, 8), (11, 12, 12), (999, 64, 32)]
)
def test_the_number_of_copies_is_rounded(people: Path, balance: int, walks: int, dances: int):
    """Of two walks and a dance, each with its mirror image."""
    source = Folder(str(people), mirror=True, balance=balance)
    assert 4 * source.copies["one"] == 4 * source.copies["two"] == walks
    assert 2 * source.copies["four"] == dances
    assert source.copies["three"] == 1


def test_a_mixture_gathers_what_its_parts_report(people: Path):
    class Part(OwnClips):
        verbs = ("walk", "jump")
        failures = ("a.bvh: damaged",)

        def clips(self, fps):
            self.leave_out("too short", 2)
            yield from super().clips(fps)

        def findings(self):
            return ["3 motions: a note"]

        def changed(self, store):
            return [f"{store} changed"]

    parts = {name: Part(clip(name)) for name in ("one", "two")}
    parts["two"].verbs = ("walk", "crawl")
    source = Mixture(parts, use="research")
    assert source.verbs == ("crawl", "jump", "walk")
    assert [clip.id for clip in source.clips(20.0)] == ["one", "two"]
    assert source.excluded == {"too short": 4}
    assert source.failures == ["a.bvh: damaged"] * 2
    assert source.failure_lines() == ["error: a.bvh: damaged"] * 2
    assert source.findings() == ["one: 3 motions: a note", "two: 3 motions: a note"]
    assert source.changed(people) == [f"{people} changed"] * 2


def test_actions_of_a_mixture_are_matched_by_name(people: Path):
    parts = {}
    for name, actions in {"one": ("walk", "jump"), "two": ("crawl", "walk")}.items():
        labels = [clip(f"{name}{k}", action=k) for k in range(2)]
        parts[name] = OwnClips(*labels, clip(f"{name} without"))
        parts[name].actions = actions
    source = Mixture(parts, use="research")
    labels = {clip.id: clip.action for clip in source.clips(20.0)}
    assert source.actions == ("walk", "jump", "crawl")
    assert [labels[f"{name}{k}"] for name in ("one", "two") for k in range(2)] == [0, 1, 2, 0]
    assert labels["one without"] is None


def test_training_on_an_unprepared_folder_knows_the_actions_of_its_clips(
    people: Path, tiny: list[str], tmp_path: Path
):
    line = [
        *(word for word in tiny if not word.startswith("data.")),
        "data=folder",
        "data.name=people",
        f"data.source.path={people}",
        f"data_root={tmp_path / 'data'}",
        "data.batch_size=2",
        "data.crop.min_frames=8",
        "callbacks.samples=null",
        "callbacks.best=null",
        "trainer.limit_val_batches=0",
        "trainer.max_steps=1",
    ]
    assert main(["train", "quickstart", *line]) == 0
    checkpoint = read_checkpoint(tmp_path / "run" / "checkpoints" / "last.ckpt")
    assert set(checkpoint["facts"]["actions"]) == {"walk", "dance"}
