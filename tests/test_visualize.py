import base64
import io
import json
import math
import sys
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image, ImageDraw, ImageSequence
from scipy.spatial.transform import Rotation
from support.browser import CHROMIUM, browser
from support.motions import HOSTILE, Page, frames_array, posed, sway, unpacked
from support.npm import in_page

from flame_mdm.errors import UserError
from flame_mdm.formats import WRITTEN
from flame_mdm.formats.motion import Motion
from flame_mdm.representations.skeleton import KIT21, SKELETONS, SMPL22
from flame_mdm.visualize import contact_sheet, render, write_gif, write_mp4, write_player
from flame_mdm.visualize.body import Figure, radii
from flame_mdm.visualize.player import packed_motion
from flame_mdm.visualize.render import SIDE_COLORS

try:
    import av
except ImportError:
    av: Any = None
MP4 = pytest.mark.skipif(av is None, reason="av is not installed: pip install flame-mdm[video]")


def test_player_holds_the_joints_to_half_a_millimetre_and_huge_ones_coarser(tmp_path, subtests):
    # Motions on one page may differ in length, rate and skeleton.
    motions = [
        sway(contacts=True),
        sway(7, 12.5, SKELETONS["kit21"]),
    ]
    write_player(tmp_path / "p.html", motions, "t")
    for number, (packed, motion) in enumerate(
        zip(Page(tmp_path / "p.html").motions, motions, strict=True)
    ):
        with subtests.test(motion=number):
            np.testing.assert_allclose(unpacked(packed), motion.joints, rtol=0, atol=0.0005 + 1e-6)
            assert (packed["fps"], packed["parents"]) == (motion.fps, list(motion.skeleton.parents))
    contacts = np.frombuffer(
        base64.b64decode(Page(tmp_path / "p.html").motions[0]["contacts"]), "u1"
    )
    np.testing.assert_array_equal(contacts.reshape(30, -1), motions[0].contacts)
    motions[0].joints *= 1000
    write_player(tmp_path / "p.html", motions[:1])
    (packed,), span = (
        Page(tmp_path / "p.html").motions,
        np.ptp(motions[0].joints, axis=(0, 1)).max(),
    )
    np.testing.assert_allclose(
        unpacked(packed), motions[0].joints, rtol=0, atol=span / 65534 / 2 + 1e-3
    )


def test_player_is_one_file_that_escapes_all_texts(tmp_path, subtests):
    write_player(tmp_path / "p.html", [sway(text=HOSTILE, id="a\u2066b")], HOSTILE)
    page = Page(tmp_path / "p.html")
    assert not {"link", "img", "iframe"} & set(page.tags)
    for reference in (
        "http:",
        "https:",
        'src="',
        "href=",
        "url(",
        "@import",
        "import(",
        "fetch(",
        "XMLHttpRequest",
    ):
        with subtests.test(reference=reference):
            assert reference not in page.source, reference
    assert page.tags.count("script") == 3
    assert page.texts["title"] == page.texts["h1"] == HOSTILE
    # The page does not rearrange texts.
    assert (page.motions[0]["caption"], page.motions[0]["id"]) == (
        HOSTILE,
        r"a\u2066b",
    )


@pytest.mark.parametrize("kind", ["known rotations", "joints of people", "other skeleton"])
@pytest.mark.parametrize(
    "ending", [*WRITTEN, ".html", ".png", "rigged.bvh", "rigged.glb", "character.glb"]
)
def test_nothing_warns_while_a_motion_is_written_or_drawn(tmp_path, ending, kind):
    if ending == ".mp4":
        pytest.importorskip("av", reason="av is not installed: pip install flame-mdm[video]")
    if ending.startswith(".usd"):
        pytest.importorskip("pxr", reason="usd-core is not installed: pip install flame-mdm[usd]")
    solved = Motion(posed(2, left_knee=(60, 0, 0)).joints, 20)
    motions = {
        "known rotations": posed(2),
        "joints of people": solved,
        "other skeleton": sway(2, skeleton=KIT21),
    }
    posed(2).save(tmp_path / "rig.glb", rig="mixamo")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        _write(motions[kind], tmp_path / f"a{ending}")


def _write(motion: Motion, path: Path) -> None:
    """Writes a file; only files of positions and pictures can contain a skeleton other than SMPL's."""
    options = {"arigged": {"rig": "unreal"}, "acharacter": {"character": path.with_name("rig.glb")}}
    if path.suffix == ".html":
        write_player(path, [motion])
    elif path.suffix == ".png":
        contact_sheet(path, [motion])
    elif motion.skeleton is KIT21 and path.suffix not in (".npz", ".json", ".npy", ".gif", ".mp4"):
        with pytest.raises(UserError, match="computed only for SMPL's 22 joints"):
            motion.save(path, **options.get(path.stem, {}))
    else:
        motion.save(path, **options.get(path.stem, {}))


def test_a_figure_of_joints_alone_is_drawn_as_a_skeleton(tmp_path):
    figure = Figure(posed().joints, 20)
    write_player(tmp_path / "p.html", [figure, posed()])
    skeleton, body = Page(tmp_path / "p.html").motions
    assert skeleton["body"] is None
    assert "rotations" in skeleton["why"]
    assert body["body"]


# Pixels of both sides and of clothes in the first panel
PIXELS = """(() => {
  redraw();
  const { canvas } = motions[0], { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
  const seen = { blue: 0, orange: 0, dark: 0 };
  for (let i = 0; i < data.length; i += 4) {
    seen.blue += data[i + 2] > data[i] + 80; seen.orange += data[i] > data[i + 2] + 80;
    seen.dark += data[i] + data[i + 1] + data[i + 2] < 260;
  }
  return seen;
})()"""


@pytest.mark.tools
@pytest.mark.skipif(CHROMIUM is None, reason="chromium is not installed")
def test_player_runs_in_a_browser(tmp_path):
    write_player(
        tmp_path / "p.html", [sway(contacts=True, text=HOSTILE, id=f"m{k}") for k in range(13)], "t"
    )
    with browser(tmp_path / "profile", 900, 700) as tab:
        tab.open((tmp_path / "p.html").as_uri())
        tab.wait("typeof motions === 'object' && motions.length === 13 && !!motions[12].figure")
        tab.run("goTo(7)")
        clothes = tab.run(PIXELS)
        tab.run("tint.click()")
        sides, button = tab.run(PIXELS), tab.run("figure.textContent")
        tab.run("figure.click()")
        sticks = tab.run(PIXELS)
        assert [button, tab.run("figure.textContent")] == ["Skeleton", "Body"]
        shown = "[scrub.value, scrub.max, filter.hidden, motions[0].joints.length, document.images.length]"
        assert tab.run(shown) == ["7", "29", False, 30 * 22 * 3, 0]
        assert tab.run("document.querySelector('figcaption p').textContent") == HOSTILE
        assert tab.errors == []
    assert clothes["orange"] < 20
    assert clothes["dark"] > 200  # trousers, shoes and hair
    assert min(sides["blue"], sides["orange"], sticks["blue"], sticks["orange"]) > 50
    assert sides["blue"] != sticks["blue"]


def test_gif_keeps_frames_and_time_and_holds_a_motion_that_ended(tmp_path, subtests):
    for fps, frames, shown in (
        *((20, 30, 30), (30, 30, 30), (12.5, 10, 10), (120, 120, 40)),
        *((5, 4, 4), (50, 4, 4), (60, 4, 2), (100, 4, 2)),
    ):
        with subtests.test(fps=fps):
            write_gif(tmp_path / "m.gif", [sway(frames, fps, text="walks")], size=64)
            with Image.open(tmp_path / "m.gif") as image:
                durations = [frame.info["duration"] for frame in ImageSequence.Iterator(image)]
                assert image.info["loop"] == 0
            assert len(durations) == shown
            assert sum(durations) == pytest.approx(1000 * frames / fps, abs=5)
            assert min(durations) >= 20  # browsers slow shorter ones down
            assert max(durations) - min(durations) <= 10
    write_gif(tmp_path / "m.gif", [sway(8), sway(16)], size=64)
    with Image.open(tmp_path / "m.gif") as image:
        assert image.width == 128
        frames = [np.asarray(frame.convert("RGB"))[:64] for frame in ImageSequence.Iterator(image)]
    assert len(frames) == 16
    np.testing.assert_array_equal(frames[8][:, :64], frames[15][:, :64])
    assert (frames[8][:, 64:] != frames[15][:, 64:]).any()


def test_motions_of_different_rates_show_the_frame_of_each_time(monkeypatch):
    shown: list[tuple[str, int]] = []

    def draw(motion: Figure, body: Any, frame: int, size: int) -> Image.Image:
        shown.append((motion.id, frame))
        return Image.new("RGB", (size, size))

    monkeypatch.setattr(render, "_figure", draw)
    motions = [sway(6, 30, id="fast"), sway(3, 20, id="slow"), sway(1, 10, id="still")]
    assert len(list(render._video(motions, 30, 32, None))) == 6
    frames = {name: [k for id, k in shown if id == name] for name in ("fast", "slow", "still")}
    assert frames == {"fast": [0, 1, 2, 3, 4, 5], "slow": [0, 0, 1, 2, 2, 2], "still": [0] * 6}
    assert len(list(render._video([sway(3, 20)], 30, 32, None))) == 5, "0.15 s are 4.5 images"


def test_a_picture_shows_the_path_up_to_its_frame_and_no_frame_after_half_a_second():
    joints = sway(40).joints
    later = joints.copy()
    later[31:] += [0.5, 0, 0.5]
    motions = (Motion(joints, 20), Motion(later, 20))
    first, second = (np.asarray(render._figure(motion, None, 20, 128)) for motion in motions)
    np.testing.assert_array_equal(first, second)

    def violet(frame: int) -> int:
        image = np.asarray(render._figure(motions[0], None, frame, 128))
        return int((np.abs(image.astype(int) - render.TRAIL).max(2) < 40).sum())

    counts = [violet(frame) for frame in (0, 10, 20)]
    assert counts[0] < counts[1] < counts[2] - 5, counts


@pytest.mark.parametrize(
    ("count", "columns", "rows"),
    [(1, 1, 1), (3, 3, 1), (4, 2, 2), (5, 3, 2), (9, 3, 3), (10, 4, 3), (17, 4, 5)],
)
def test_panels_stand_in_at_most_four_columns(monkeypatch, count, columns, rows):
    monkeypatch.setattr(
        render, "_figure", lambda motion, body, frame, size: Image.new("RGB", (size, size))
    )
    figure = Figure(sway(1).joints, 20, text="a")
    (image,) = render._video([figure] * count, 20, 32, None)
    assert image.width == 32 * columns
    assert image.height // rows >= 32
    assert (image.height - 3) % rows == 0


def test_the_camera_follows_the_mean_root_of_a_second(monkeypatch):
    centers, original = [], render._camera

    def camera(center: np.ndarray, side: int) -> Any:
        centers.append(center.tolist())
        return original(center, side)

    monkeypatch.setattr(render, "_camera", camera)
    joints = sway(40).joints * 0
    joints[..., 0] += np.arange(40)[:, None]
    joints[..., 1] += 2.0
    for frame in (0, 20, 38):
        render._figure(Figure(joints, 20), None, frame, 16)
    render._figure(Figure(joints * [1, 0.45, 1], 20), None, 20, 16)
    np.testing.assert_allclose(
        centers, [[5, 1.75, 0], [20, 1.75, 0], [33.5, 1.75, 0], [20, 0.85, 0]]
    )


def test_a_foot_is_marked_in_the_frames_of_its_contact():
    joints = sway(3).joints

    def green(foot: int, frame: int) -> np.ndarray:
        contacts = np.zeros((3, 4), bool)
        contacts[1, foot] = True
        image = np.asarray(render._figure(Figure(joints, 20, contacts=contacts), None, frame, 128))
        red, green, blue = image.astype(int).transpose(2, 0, 1)
        return np.nonzero((green > red + 60) & (green > blue + 20))[1]

    assert [len(green(1, frame)) > 0 for frame in range(3)] == [False, True, False]
    assert green(1, 1).mean() > green(3, 1).mean(), "the left foot is on the right of the picture"


def test_a_thumbnail_shows_the_pose_farthest_from_the_first(monkeypatch):
    motion, shown, original = sway(5), [], render._figure
    motion.joints[:] = motion.joints[0]
    motion.joints[:, :, 0] += np.arange(5)[:, None]
    motion.joints[2, 20] += 0.5
    motion.joints[3, 20:22] += 0.3
    motion.joints[4, :, 1] -= 0.2  # a body that is lower has a different pose

    def draw(motion: Figure, body: Any, frame: int, size: int) -> Image.Image:
        shown.append(frame)
        return original(motion, body, frame, size)

    monkeypatch.setattr(render, "_figure", draw)
    image = Image.open(io.BytesIO(render.thumbnail(motion, 60)))
    assert shown == [4]
    assert (image.format, image.size) == ("WEBP", (42, 60))


def test_poses_of_a_contact_sheet_are_labeled_with_their_seconds(tmp_path, monkeypatch):
    texts, original = [], ImageDraw.ImageDraw.text

    def write(pen: Any, at: Any, text: str, *args: Any) -> None:
        texts.append(text)
        original(pen, at, text, *args)

    monkeypatch.setattr(ImageDraw.ImageDraw, "text", write)
    contact_sheet(tmp_path / "sheet.png", [sway(30, 12.5, text="walks")], frames=3, size=96)
    assert texts[:3] == ["0.00 s", "1.12 s", "2.32 s"]


def test_radii_grow_with_the_number_of_joints_below():
    at = dict(zip(SMPL22.joints, radii(SMPL22), strict=True))
    names = ("head", "right_foot", "left_ankle", "left_hip", "spine3", "pelvis")
    expected = [0.024 + 0.011 * below**0.5 for below in (0, 0, 1, 3, 10, 21)]
    assert [at[name] for name in names] == pytest.approx(expected, abs=1e-4)


def test_a_player_that_starts_later_has_the_same_frames():
    motion = posed(12, heading=np.linspace(0, 2, 12), left_elbow=(0, -80, 0))
    motion.contacts = np.arange(48).reshape(12, 4) % 3 == 0
    whole, late = (packed_motion(motion, begin) for begin in (0, 5))
    assert (whole["frames"], late["frames"]) == (12, 7)
    parts = ((whole["joints"], late["joints"]), (whole["contacts"], late["contacts"]))
    for complete, part in (*parts, (whole["body"]["turns"], late["body"]["turns"])):
        all_bytes, last_bytes = map(base64.b64decode, (complete, part))
        assert all_bytes[len(all_bytes) * 5 // 12 :] == last_bytes
    for name in ("center", "step", "fps", "feet"):
        assert whole[name] == late[name], name


def test_packed_rotations_are_exact_to_a_tenth_of_a_degree():
    rng = np.random.default_rng(0)
    motion = posed(30, heading=rng.uniform(-3, 3, 30), left_hip=rng.normal(0, 40, (30, 3)))
    fitted, _ = motion.try_fit()
    assert fitted is not None
    values = np.frombuffer(base64.b64decode(packed_motion(motion)["body"]["turns"]), "<u4")
    largest, parts = values >> 30, np.stack([values >> 20, values >> 10, values], 1) & 1023
    parts = (parts / 1023 - 0.5) * 2**0.5
    quaternions = np.empty((len(values), 4))
    quaternions[np.arange(4) != largest[:, None]] = parts.ravel()
    rest = np.sqrt(1 - (parts**2).sum(1))
    quaternions[np.arange(len(values)), largest] = rest
    turned = Rotation.from_matrix(fitted.turns.reshape(-1, 3, 3))
    off = np.degrees((Rotation.from_quat(quaternions) * turned.inv()).magnitude())
    assert off.max() < 0.2
    assert set(largest.tolist()) == {0, 1, 2, 3}


@pytest.mark.parametrize(
    "write", [write_player, write_gif, pytest.param(write_mp4, marks=MP4), contact_sheet]
)
def test_writers_give_the_same_bytes_and_leave_nothing_where_they_fail(tmp_path, write):
    with pytest.raises(UserError, match=r"out\.x: no motions to show"):
        write(tmp_path / "out.x", [])
    assert list(tmp_path.iterdir()) == []
    for name in "ab":
        write(tmp_path / name, [sway(5, contacts=True, text="walks")])
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def test_frames_show_both_sides_and_height_of_a_skeleton(subtests):
    motion = sway(3, skeleton=SKELETONS["kit21"])
    frames = frames_array(motion, size=128)
    assert frames.shape == (3, 128, 128, 3)
    motion.joints[:, :, 1] += 0.3
    images = [frames[0].astype(int), frames_array(motion, size=128)[0].astype(int)]
    for side in (-1, 1):
        with subtests.test(side=side):
            rows, lifted = (
                np.nonzero((np.abs(image - SIDE_COLORS[side]) < 12).all(-1))[0] for image in images
            )
            assert len(rows) > 30
            assert rows.mean() - lifted.mean() == pytest.approx(0.3 * 2.05 * 128 / 5, rel=0.2)


def test_contact_sheet_shows_first_to_last_pose_of_each_motion(tmp_path):
    motions = [sway(30, text="walks"), sway(4, text="walks briefly")]
    contact_sheet(tmp_path / "sheet.png", motions, frames=3, size=96)
    sheet = np.asarray(Image.open(tmp_path / "sheet.png"))
    assert sheet.shape[1:] == (3 * 96, 3)
    last = frames_array(motions[0], size=96)[-1]
    np.testing.assert_array_equal(sheet[24:96, -96:], last[24:])  # the time stands above
    np.testing.assert_array_equal(
        sheet[sheet.shape[0] // 2 + 24 :][:60, :96], frames_array(motions[1], 96)[0][24:84]
    )


@MP4
@pytest.mark.parametrize("rates", [(10, 20), (20, 10)])
def test_mp4_of_several_motions_has_the_highest_of_their_frame_rates(tmp_path, rates):
    write_mp4(tmp_path / "m.mp4", [sway(rate, rate) for rate in rates], size=64)
    with av.open(str(tmp_path / "m.mp4")) as file:
        assert float(file.streams.video[0].average_rate or 0) == 20
        assert len(list(file.decode(video=0))) == 20


@pytest.mark.slow
@MP4
def test_mp4_has_the_frames_of_the_motion_and_the_colors_of_the_gif(tmp_path, subtests):
    for fps, size in ((12.5, 65), (29.97, 64), (120, 64)):
        with subtests.test(fps=fps, size=size):
            write_mp4(tmp_path / "m.mp4", [sway(12, fps, text="walks"), sway(5, fps)], size=size)
            with av.open(str(tmp_path / "m.mp4")) as file:
                stream, frames = file.streams.video[0], list(file.decode(video=0))
                assert (stream.codec_context.name, stream.codec_context.pix_fmt) == (
                    "h264",
                    "yuv420p",
                )
                assert float(stream.average_rate or 0) == pytest.approx(fps, rel=1e-6)
            assert len(frames) == 12
            assert (frames[-1].time or 0) - (frames[0].time or 0) == pytest.approx(
                11 / fps, rel=1e-3
            )
            assert (frames[0].width, frames[0].height % 2) == (2 * size, 0)

    # it shows what a GIF shows, in its colors
    motions = [sway(8, text="walks"), sway(16)]
    assert (
        motions[0]
        .save(tmp_path / "m.MP4")
        .endswith("m.MP4: 8 frames at 20 per second, H.264 video")
    )
    assert (tmp_path / "m.MP4").read_bytes().startswith(b"\0\0\0\x20ftyp")
    write_gif(tmp_path / "m.gif", motions, size=128)
    write_mp4(tmp_path / "m.mp4", motions, size=128)
    with Image.open(tmp_path / "m.gif") as image:
        shown = np.stack(
            [np.asarray(frame.convert("RGB"), int) for frame in ImageSequence.Iterator(image)]
        )
    with av.open(str(tmp_path / "m.mp4")) as file:
        video = np.stack([frame.to_ndarray(format="rgb24") for frame in file.decode(video=0)])
    assert len(video) == len(shown) == 16
    shown = shown[:, : video.shape[1]]
    off = np.abs(video[:, None] - shown[None]).mean((2, 3, 4))
    assert (off.argmin(1) == np.arange(16)).all()
    assert off.diagonal().max() < 2.5


def test_mp4_without_its_package_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(
        UserError,
        match=r'm\.mp4: MP4 requires the av package\. Run pip install "flame-mdm\[video\]", or',
    ):
        write_mp4(tmp_path / "m.mp4", [sway(2)])
    assert list(tmp_path.iterdir()) == []


def test_bad_motions_are_refused_by_name(subtests):
    joints = sway(4).joints
    joints[2, 5, 1] = np.nan
    good = {"joints": np.zeros((4, 22, 3)), "fps": 20, "skeleton": SKELETONS["smpl22"], "id": "m"}
    for change, message in (
        ({"joints": joints}, "'m': the position of joint 5 in frame 2 is NaN or infinite"),
        ({"joints": np.zeros((0, 22, 3))}, r"'m': joints have shape \(0, 22, 3\)"),
        (
            {"joints": np.zeros((4, 24, 3))},
            r"'m': joints have shape \(4, 24, 3\), but smpl22 needs \(frames, 22, 3\)",
        ),
        ({"fps": 0}, "'m': fps is 0"),
        ({"fps": float("nan")}, "'m': fps is nan"),
        ({"contacts": np.zeros((3, 4))}, r"contacts have shape \(3, 4\), expected \(4, 4\)"),
    ):
        with subtests.test(change=change, message=message), pytest.raises(UserError, match=message):
            Motion(**{**good, **change})


def test_the_camera_stands_in_front_of_the_body_to_its_left_and_above():
    center = np.array([1.0, 0.9, 2.0])
    project = render._camera(center, 200)
    np.testing.assert_allclose(project(center[None]), [[100, 100, 82, 5]], atol=1e-9)
    steps = 0.2 * np.eye(3)
    left, up, ahead = project(center + steps)
    assert left[0] > 100 + 10
    assert up[1] < 100 - 10
    assert abs(up[0] - 100) < 1e-9
    assert ahead[0] < 100
    assert min(left[3], up[3], ahead[3]) > 4.7
    assert max(left[3], up[3], ahead[3]) < 5
    behind = project(center + 9 * render.TOWARD[None])
    assert behind[0, 3] == 0.3, "never closer than this"


def test_surfaces_are_lit_from_the_upper_left_of_the_camera():
    normals = np.array([-render.RIGHT, render.RIGHT, [0, 1, 0], [0, -1, 0], render.TOWARD])
    left, right, above, below, ahead = render._shaded(normals, np.full((5, 3), 100.0))[:, 0]
    assert above > ahead > left > right > below
    assert (right, below) == pytest.approx((50, 38))
    assert render._shaded(normals, np.full((5, 3), 255.0)).max() == 255


def test_a_caption_has_at_most_three_lines():
    lines = render._lines(sway(text="a person walks " * 9), posed().try_fit()[0], 192, 192)
    assert len(lines) == 3
    assert lines[2].endswith(" …")
    assert render._lines(sway(text="walks"), None, 192, 192) == ["walks", "(no body fits)"]


def test_the_bar_below_the_panels_grows_until_the_last_image(monkeypatch):
    monkeypatch.setattr(
        render, "_figure", lambda motion, body, frame, size: Image.new("RGB", (size, size), "white")
    )
    images = list(render._video([Figure(sway(4).joints, 20, text="a")] * 2, 20, 64, None))
    rows = [np.asarray(image)[-3:] for image in images]
    lengths = [(row == render.TRAIL).all(-1).all(0).sum() for row in rows]
    assert lengths == pytest.approx([32, 64, 96, 128], abs=1)


def test_a_page_holds_what_its_script_needs_to_draw_the_body(tmp_path):
    """As in the page: the mesh is fitted to the body at rest, and then each bone moves it."""
    turns: dict[str, Any] = {"left_hip": (-50, 10, 0), "left_knee": (70, 0, 0)}
    motion = posed(3, 0.93, heading=[0.3, 1.5, 2.8], right_elbow=(0, 60, 0), **turns)
    write_player(tmp_path / "p.html", [motion])
    page = Page(tmp_path / "p.html")
    (packed,), mesh = page.motions, json.loads(page.texts["body"])

    def array(text: str, kind: str, width: int) -> np.ndarray:
        return np.frombuffer(base64.b64decode(text), kind).reshape(-1, width).astype(float)

    anchors, joints = mesh["anchors"], np.reshape(mesh["joints"], (22, 3))
    weights = np.zeros((len(array(mesh["points"], "<i2", 3)), len(anchors)))
    for bone, weight in zip(
        array(mesh["bones"], "u1", 4).T, array(mesh["weights"], "u1", 4).T, strict=True
    ):
        weights[np.arange(len(weights)), bone.astype(int)] += weight / 255

    def moved(points: np.ndarray, matrices: np.ndarray, start: Any, end: Any) -> np.ndarray:
        by_bone = np.einsum("bij,vbj->vbi", matrices, points[:, None] - start[anchors])
        return np.einsum("vb,vbi->vi", weights, by_bone + end[anchors])

    fit = array(packed["body"]["fit"], "<f4", 9).reshape(-1, 3, 3)
    rest = array(packed["body"]["rest"], "<f4", 3)
    points = moved(array(mesh["points"], "<i2", 3) / 20000, fit[anchors], joints, rest)
    bits = array(packed["body"]["turns"], "<u4", len(anchors)).astype(np.uint32)
    drawn, _ = motion.try_fit()
    assert drawn is not None
    for frame, row in enumerate(bits):
        parts = (np.stack([row >> 20, row >> 10, row], 1) & 1023) / 1023 - 0.5
        quaternions = [
            np.insert(part, largest, np.sqrt(1 - (part**2).sum()))
            for part, largest in zip(2**0.5 * parts, row >> 30, strict=True)
        ]
        turned = Rotation.from_quat(quaternions).as_matrix()
        ends = unpacked(packed)[frame] + [0, packed["body"]["lift"], 0]
        vertices = moved(points, turned, rest, ends)
        np.testing.assert_allclose(vertices, drawn.skinned(frame)[0], atol=3e-3)


def test_lines_on_the_ground_are_at_whole_meters():
    joints = sway(3).joints.astype(float)

    def picture(offset: list[float]) -> np.ndarray:
        figure = Figure(joints + np.array(offset), 20)
        return np.asarray(render._figure(figure, None, 1, 96)).astype(int)

    first = picture([0, 0, 0])
    assert np.abs(picture([2, 0, -3]) - first).mean() < 0.05
    assert np.abs(picture([0.5, 0, 0]) - first).mean() > 0.5
    assert np.abs(picture([0, 0, 0.5]) - first).mean() > 0.5


def test_groups_neighbors_and_marks_of_a_page_belong_to_their_motions(tmp_path):
    motions = [sway(4, id="a"), sway(5, id="b"), sway(6, id="c")]
    marks = [[(1, 3, "pop", "head")], [], [(0, 2, "skating", "toe"), (4, 6, "pop", "knee")]]
    options: dict[str, Any] = {"groups": ["x", "", "y"], "beside": ["", "a", ""], "marks": marks}
    write_player(tmp_path / "p.html", motions, columns=3, about="<b>text</b>", **options)
    page = Page(tmp_path / "p.html")
    shown = [
        [motion[key] for key in ("id", "group", "beside", "frames")] for motion in page.motions
    ]
    assert shown == [["a", "x", "", 4], ["b", "", "a", 5], ["c", "y", "", 6]]
    assert [motion["marks"] for motion in page.motions] == json.loads(json.dumps(marks))
    assert "<details><summary>About these motions</summary><div><b>text</b></div>" in page.source
    assert "fixed = 3," in page.source


def turning(frames: int, fps: float, name: str) -> Motion:
    """A body that turns, bends its left elbow, and walks ahead at 1 m/s."""
    bends = np.linspace(0, -100, frames)
    angles = np.stack([0 * bends, bends, 0 * bends], 1)
    path = np.arange(frames)[:, None] / fps * [0.3, 0, 1.0] + [0, 0.955, 0]
    motion = posed(frames, heading=np.linspace(0, 2, frames), root=path, left_elbow=angles)
    motion.fps, motion.id, motion.text = fps, name, f"{name} walks"
    return motion


def test_the_script_of_a_page_moves_the_mesh_as_pictures_do(tmp_path):
    motions = [turning(4, 20, "a"), turning(3, 20, "b")]
    write_player(tmp_path / "p.html", motions)
    shown = [(0, 0), (0, 3), (1, 2)]
    values = in_page(
        tmp_path / "p.html", *(f"skinned(motions[{motion}], {frame})" for motion, frame in shown)
    )
    for (motion, frame), (points, slopes) in zip(shown, values, strict=True):
        fitted, _ = motions[motion].try_fit()
        assert fitted is not None
        expected, normals = fitted.skinned(frame)
        np.testing.assert_allclose(np.reshape(points, (-1, 3)), expected, atol=3e-3)
        turned = np.reshape(slopes, (-1, 3))
        turned /= np.linalg.norm(turned, axis=1, keepdims=True)
        assert ((turned * normals).sum(1) > 0.999).all()


@pytest.mark.parametrize("independently", [False, True])
def test_a_page_shows_the_frame_of_each_time_and_states_frames_and_seconds(
    tmp_path, independently: bool
):
    motions = [turning(7, 12.5, "slow"), turning(12, 30, "fast")]
    write_player(tmp_path / "p.html", motions)
    fps, seconds, last, *rows = in_page(
        tmp_path / "p.html",
        *("fps", "seconds", "lastTick"),
        f"var drawn = []; element('each').checked = {json.dumps(independently)}; 0",
        "drawBody = (context, m, frame) => drawn.push(frame); 0",
        *(
            f"goTo({tick}); drawn = []; redraw(); [drawn, motions.map((m) => m.figure.classList.has('ended')),"
            " element('clock').textContent]"
            for tick in (0, 2, 5, 11, 12, 16, 40)
        ),
    )
    assert (fps, seconds, last) == (30, pytest.approx(0.56), 16)
    for tick, (drawn, ended, clock) in zip((0, 2, 5, 11, 12, 16, 16), rows[2:], strict=True):
        times = [tick / 30 % (len(m.joints) / m.fps if independently else 99) for m in motions]
        frames = [
            min(int(time * m.fps + 1e-6), len(m.joints) - 1)
            for time, m in zip(times, motions, strict=True)
        ]
        assert drawn == frames, tick
        assert ended == [False, tick >= 12 and not independently]
        assert clock.replace("\u2007", " ") == f"frame {tick:2d} / 16   {tick / 30:.2f} / 0.56 s"


def test_the_camera_of_a_page_follows_the_mean_root_of_a_second_and_sees_as_pictures_do(tmp_path):
    motion = turning(30, 12.5, "a")
    write_player(tmp_path / "p.html", [motion])
    points = [[0.3, 0, 0.2], [1.0, 0, -1], [0.4, 1.5, 2], [-0.7, 0.4, 1]]
    (path, views) = in_page(
        tmp_path / "p.html",
        "motions[0].path",
        "[[0.6, 0.24, 1], [2.5, 0.9, 2]].map(([yaw, pitch, zoom]) => { Object.assign(view, { yaw, pitch, zoom });"
        " draw(motions[0], 0.8 + 0.01); const { project, floorAt, canvas } = motions[0];"
        f" return {json.dumps(points)}.map((point) => {{ const p = project(...point);"
        " return [p.x - canvas.width / 2, p.y - canvas.height / 2, p.depth, p.scale, ...floorAt(p.x, p.y),"
        " Math.min(canvas.height, 1.1 * canvas.width)]; }); })",
    )
    root = motion.joints[:, 0, [0, 2]].astype(float)
    half = math.floor(12.5 / 2 + 0.5)
    means = [root[max(0, f - half) : f + half + 1].mean(0) for f in range(30)]
    np.testing.assert_allclose(path, means, atol=1e-3)

    top = motion.joints[..., 1].max()
    x, z = path[10]  # at 0.8 seconds
    center = np.array([x, np.clip(top / 2 + 0.1, 0.5, 1.1), z])
    for (yaw, pitch, zoom), rows in zip(((0.6, 0.24, 1), (2.5, 0.9, 2)), views, strict=True):
        sy, cy, sp, cp = np.sin(yaw), np.cos(yaw), np.sin(pitch), np.cos(pitch)
        toward, right = np.array([sy * cp, sp, cy * cp]), np.array([cy, 0, -sy])
        up = np.cross(toward, right)
        distance = rows[0][2] + (points[0] - center) @ toward
        assert distance * zoom == pytest.approx(max(4.2, 2.6 * top, 4.4), rel=0.02)
        for point, (across, down, depth, scale, floor_x, floor_z, size) in zip(
            points, rows, strict=True
        ):
            offset = point - center
            assert depth == pytest.approx(distance - offset @ toward)
            assert scale == pytest.approx(2 * size / depth)
            np.testing.assert_allclose(
                [across, down], [offset @ right * scale, -offset @ up * scale], atol=0.2
            )  # coordinates are rounded to millimeters
            if point[1] == 0:
                np.testing.assert_allclose([floor_x, floor_z], [point[0], point[2]], atol=1e-6)


def test_marks_of_a_page_are_at_their_seconds_and_lead_to_their_frames(tmp_path):
    motions = [turning(12, 30, "fast"), turning(10, 12.5, "slow")]
    marks = [[(3, 6, "pop", "head")], [(2, 4, "skating", "toe"), (4, 10, "pop", "knee")]]
    write_player(tmp_path / "p.html", motions, marks=marks)
    buttons, ticks, texts = in_page(
        tmp_path / "p.html",
        "element('marks').children.map((c) => [c.title, c.style.left, c.style.width, c.style.top])",
        "element('marks').children.map((c) => { c.click(); return tickNow(); })",
        "[0, 3, 5, 6].map((tick) => { goTo(tick); redraw(); return motions.map((m) =>"
        " [m.figure.querySelector('figcaption p').textContent, m.figure.classList.has('faulty')]); })",
    )
    expected = []
    for motion, spans in zip(motions, marks, strict=True):
        for start, end, kind, text in spans:
            left, width = (100 * frames / motion.fps / 0.8 for frames in (start, end - start))
            top = f"{8 * ['pop', 'skating'].index(kind)}px"
            expected.append((f"{motion.id}: {text}", left, width, top))
    for (title, left, width, top), row in zip(buttons, expected, strict=True):
        assert (title, top) == (row[0], row[3])
        assert [float(size[:-1]) for size in (left, width)] == pytest.approx(row[1:3])
    # The first frame of a span at 30 images per second
    assert ticks == [3, math.ceil(2 / 12.5 * 30), math.ceil(4 / 12.5 * 30)]
    fast, slow = ([row[k] for row in texts] for k in (0, 1))
    plain = ["fast walks", False]
    assert fast == [plain, ["head", True], ["head", True], plain]
    assert slow == [["slow walks", False]] * 2 + [["toe", True]] * 2


def test_a_page_is_filtered_by_words_and_groups_together_with_originals(tmp_path):
    motions = [turning(2, 20, name) for name in ("ann", "ann edited", "bob", "carl")]
    options: dict[str, Any] = {"groups": ["x", "", "y", "y"], "beside": ["", "ann", "", ""]}
    write_player(tmp_path / "p.html", motions, **options)
    rows = in_page(
        tmp_path / "p.html",
        "element('group').children.map((option) => option.value)",
        *(
            f"element('filter').value = '{words}'; element('group').value = '{group}'; narrow();"
            " [shown().map((m) => m.id), element('count').textContent]"
            for words, group in (("", ""), ("Walks BOB", ""), ("edited", ""), ("", "y"), ("", "x"))
        ),
    )
    assert rows == [
        ["x", "y"],
        [["ann", "ann edited", "bob", "carl"], ""],
        [["bob"], "1 of 4"],
        [["ann", "ann edited"], "2 of 4"],
        [["bob", "carl"], "2 of 4"],
        [["ann", "ann edited"], "2 of 4"],
    ]


def test_joints_that_a_page_saves_are_those_of_the_visible_motions(tmp_path):
    motions = [turning(3, 12.5, "a"), sway(2, 30, SKELETONS["kit21"], id="b", text="sways")]
    write_player(tmp_path / "p.html", motions)
    (text,) = in_page(
        tmp_path / "p.html",
        "element('filter').value = 'sways'; narrow(); var link;"
        " document.createElement = () => (link = { click() {} }); element('save').click(); link.href",
    )
    (saved,) = json.loads(text)
    assert (saved["id"], saved["caption"], saved["fps"]) == ("b", "sways", 30)
    assert saved["parents"] == list(motions[1].skeleton.parents)
    np.testing.assert_allclose(saved["joints"], motions[1].joints, atol=0.0006)


def test_contacts_of_a_page_are_dots_on_the_ground_up_to_the_shown_frame(tmp_path):
    contacts = np.arange(24).reshape(6, 4) % 5 == 0
    motion = sway(6)
    motion.contacts = contacts
    write_player(tmp_path / "p.html", [motion])
    rows = in_page(
        tmp_path / "p.html",
        *(
            f"strokes.length = 0; goTo({frame}); redraw(); strokes.filter(({{ name, words }}) => name === 'ellipse')"
            ".map(({ words }) => [...motions[0].floorAt(words[0], words[1]), words[2]])"
            for frame in (0, 3, 5)
        ),
    )
    feet = motion.skeleton.feet
    for frame, dots in zip((0, 3, 5), rows, strict=True):
        expected = [
            (*motion.joints[f, joint, [0, 2]].tolist(), f == frame)
            for k, joint in enumerate(feet)
            for f in range(frame + 1)
            if contacts[f, k]
        ]
        np.testing.assert_allclose(
            [dot[:2] for dot in dots], [dot[:2] for dot in expected], atol=2e-3
        )
        sizes = np.array([dot[2] for dot in dots])
        now = np.array([dot[2] for dot in expected])
        if now.any():
            assert sizes[now].min() > 2 * max(sizes[~now], default=0)


def test_limbs_of_a_page_have_the_color_of_their_side_and_the_nearest_is_drawn_last(tmp_path):
    motion = sway(2)
    write_player(tmp_path / "p.html", [motion])
    (parts,) = in_page(
        tmp_path / "p.html",
        "var parts = []; bodies = false; limb = (context, part) => parts.push(part); draw(motions[0], 0);"
        " parts.map(({ ra, rb, a, b, depth, color }) => [ra / a.scale, rb / b.scale, depth, (a.depth + b.depth) / 2,"
        " ['left', 'right', 'middle'].find((name) => colors[name] === color)])",
    )
    depths = [part[2] for part in parts]
    assert depths == sorted(depths, reverse=True)
    thick, names = radii(SMPL22), SMPL22.joints
    expected = [(0.08, 0.09, "middle")]
    for parent, joint in SMPL22.edges:
        sides = {names[k].split("_")[0] for k in (parent, joint)}
        side = sides.pop() if len(sides) == 1 else "middle"
        color = side if side in ("left", "right") else "middle"
        expected.append((min(thick[parent], 1.35 * thick[joint]), thick[joint], color))
    shown = sorted((round(ra, 6), round(rb, 6), color) for ra, rb, _, _, color in parts)
    assert shown == sorted((round(a, 6), round(b, 6), color) for a, b, color in expected)


def test_vertices_of_the_left_half_of_a_body_have_the_color_of_the_left(tmp_path):
    write_player(tmp_path / "p.html", [posed(1)])
    points, sides = in_page(
        tmp_path / "p.html",
        "mesh.points",
        "Array.from({ length: mesh.count }, (_, v) => sideOf(motions[0], v))",
    )
    across, half = np.reshape(points, (-1, 3))[:, 0], np.array(sides)
    assert half[across > 0.2].min() > 0.5
    assert half[across < -0.2].max() < -0.5
    assert set(np.round(half[np.abs(across) > 0.4], 6)) == {-1.0, 1.0}
    assert np.abs(half).max() <= 1 + 1e-6


def test_keys_move_a_page_by_frames_and_stop_it(tmp_path):
    write_player(tmp_path / "p.html", [turning(8, 20, "a")])
    keys = ["ArrowRight", "ArrowRight", "ArrowLeft", "End", "ArrowRight", "Home", "ArrowLeft"]
    ticks, states = in_page(
        tmp_path / "p.html",
        "var press = (key) => listeners.keydown({ key, target: { tagName: 'BODY', type: '' }, preventDefault() {} });"
        f" {json.dumps(keys)}.map((key) => {{ press(key); return tickNow(); }})",
        "[' ', 'ArrowRight', 'b', ' ', ' '].map((key) => { press(key); return [playing, bodies]; })",
    )
    assert ticks == [1, 2, 1, 7, 7, 0, 0]
    assert states == [[True, True], [False, True], [False, False], [True, False], [False, False]]


@pytest.mark.parametrize(("loops", "tick", "playing"), [(True, 2, True), (False, 7, False)])
def test_a_page_plays_at_its_speed_and_begins_again_only_if_it_loops(
    tmp_path, loops: bool, tick: int, playing: bool
):
    """Eight frames take 0.4 seconds. At half speed, a second is 0.1 seconds after the end."""
    write_player(tmp_path / "p.html", [turning(8, 20, "a")])
    ((early, late, is_playing),) = in_page(
        tmp_path / "p.html",
        f"element('loop').checked = {json.dumps(loops)}; element('speed').value = '0.5'; setPlaying(true);"
        " step(1000); step(1520); const early = tickNow(); step(2020); [early, tickNow(), playing]",
    )
    assert (early, late, is_playing) == (5, tick, playing)


def live_page(path: Path, motion: Motion) -> None:
    """Writes the page of a stream: a page of one motion that is marked as live."""
    write_player(path, [motion])
    page = path.read_text(encoding="utf-8")
    path.write_text(page.replace('[{"id":', '[{"live":true,"id":', 1), encoding="utf-8")


@pytest.mark.parametrize(
    ("shown", "begin", "first"),
    [(3, 118, 0), (115, 118, 15), (115, 112, 12)],  # 100 frames before the shown or the new ones
)
def test_frames_of_a_stream_replace_those_that_follow_and_100_earlier_ones_are_kept(
    tmp_path, shown: int, begin: int, first: int
):
    motion = turning(120, 20, "a")
    live_page(tmp_path / "p.html", motion)
    later = turning(140, 20, "b")
    block = json.dumps({"from": begin, "motion": packed_motion(later, 130)})
    frames, joints, (points, _), cut = in_page(
        tmp_path / "p.html",
        "var send = (data) => listeners.message({ source: parent, data }); drawBody = () => {};"
        f" send({{ frame: {shown} }}); send({block}); [live.begin, live.frames]",
        "live.joints",
        "skinned(live, live.frames - 1)",
        "[[0, 1], [2.5, 3]].map((values) => appended(Float32Array.from([7, 8, 9]), 1, 2, values))",
    )
    assert frames == [first, begin - first + 10]
    expected = np.concatenate([motion.joints[first:begin], later.joints[130:]])
    np.testing.assert_allclose(np.reshape(joints, (-1, 22, 3)), expected, atol=0.003)
    fitted, _ = later.try_fit()
    assert fitted is not None
    np.testing.assert_allclose(np.reshape(points, (-1, 3)), fitted.skinned(139)[0], atol=0.006)
    assert cut == [[8, 0, 1], [8, 2.5, 3]]


def test_the_camera_of_a_stream_comes_nearer_by_8_percent_per_frame(tmp_path):
    motion = turning(40, 20, "a")
    live_page(tmp_path / "p.html", motion)
    (cameras,) = in_page(
        tmp_path / "p.html",
        "drawBody = () => {}; const send = (frame) => listeners.message({ source: parent, data: { frame } });"
        " [1, 5, 20].map((frame) => { send(frame); return [...live.camera]; })",
    )
    camera, before = motion.joints[0, 0, [0, 2]].astype(float), 0
    for frame, actual in zip((1, 5, 20), cameras, strict=True):
        goal = motion.joints[frame, 0, [0, 2]]
        camera = goal + 0.92 ** (frame - before) * (camera - goal)
        np.testing.assert_allclose(actual, camera, atol=1e-3)
        before = frame


def test_a_click_in_a_stream_names_a_waypoint_or_a_point_on_the_floor_within_20_meters(tmp_path):
    live_page(tmp_path / "p.html", turning(4, 20, "a"))
    floor = [[1.0, 2.0], [-3.0, 1.0], [0.5, -13.0], [-16.0, -16.0]]
    (messages,) = in_page(
        tmp_path / "p.html",
        "drawBody = () => {}; const send = (data) => listeners.message({ source: parent, data });"
        " send({ points: [[1, 2], [-3, 1]], frame: 1 });"
        f" for (const [x, z] of {json.dumps(floor)}) {{ const p = live.project(x, 0, z); clickFloor(p.x, p.y); }}"
        " posted",
    )
    assert messages[:2] == [{"point": 0}, {"point": 1}]
    (message,) = messages[2:]  # the last point is too far away
    np.testing.assert_allclose(message["floor"], floor[2], atol=1e-3)


@pytest.mark.parametrize(
    ("count", "columns", "expected"),
    [(1, 0, 1), (2, 0, 2), (3, 0, 3), (4, 0, 3), (5, 4, 4), (6, 0, 3)],
)
def test_panels_of_a_page_are_as_large_as_the_window_allows(
    tmp_path, count: int, columns: int, expected: int
):
    figures = [Figure(sway(1).joints, 20, id=str(k)) for k in range(count)]
    write_player(tmp_path / "p.html", figures, columns=columns)
    style, starts, scrolls = in_page(
        tmp_path / "p.html",
        "main.style.gridTemplateColumns",
        "motions.map((m) => m.figure.style.gridColumnStart)",
        "main.classList.has('scrolls')",
    )
    assert style == f"repeat({expected}, minmax(0, 1fr))"
    assert starts == [1 + k % expected for k in range(count)]
    assert scrolls == (count > 3)


def test_limbs_of_a_picture_are_drawn_from_back_to_front_and_the_shadow_is_on_the_ground(
    monkeypatch,
):
    """A body that jumps: its shadow is straight below it, a quarter as large before it is enlarged."""
    joints = sway(3).joints + np.array([0, 0.5, 0])
    figure, drawn = Figure(joints, 20), []

    def capsule(pen: Any, a: Any, b: Any, radius: float, color: Any, grow: float = 0) -> None:
        drawn.append((np.array(a), np.array(b), radius, color, grow))

    monkeypatch.setattr(render, "_capsule", capsule)
    render._figure(figure, None, 1, 96)
    edges = SMPL22.edges
    dark, limbs = drawn[: len(edges)], drawn[len(edges) :]
    x, y, z = joints[:, 0].mean(0)
    project = render._camera(np.array([x, max(0.85, y - 0.25), z]), 192)
    below = project(joints[1] * [1, 0, 1]) * [0.25, 0.25, 0.25, 1]
    for (parent, joint), (a, b, _, color, grow) in zip(edges, dark, strict=True):
        np.testing.assert_allclose([a, b], [below[parent], below[joint]])
        assert (color, grow) == (255, 0)

    rims, fills = limbs[::2], limbs[1::2]
    depths = [a[3] + b[3] for a, b, *_ in fills]
    assert len(fills) == len(edges) + 1  # and the head
    assert depths == sorted(depths, reverse=True)
    at, thick = project(joints[1]), radii(SMPL22)
    for rim, fill in zip(rims, fills, strict=True):
        np.testing.assert_allclose([rim[0], rim[1]], [fill[0], fill[1]])
        side = next(key for key, color in SIDE_COLORS.items() if color == fill[3])
        assert rim[3] == render.RIM_COLORS[side]
        assert (rim[4], fill[4]) == (pytest.approx(0.75), 0)
        if fill[2] == 0.085:
            assert side == 0
            continue
        (parent, joint) = next(
            edge
            for edge in edges
            if np.allclose(at[edge[1]], fill[1]) and thick[edge[1]] == fill[2]
        )
        names = [SMPL22.joints[number].split("_")[0] for number in (parent, joint)]
        expected = {"left": 1, "right": -1}.get(names[1], 0) if names[0] == names[1] else 0
        assert side == expected


def test_a_page_contains_the_mesh_if_any_of_its_motions_has_a_body(tmp_path):
    for motions, is_drawn in (
        ([sway(2, skeleton=KIT21), posed(2)], True),
        ([posed(2), Figure(posed(2).joints, 20)], True),
        ([sway(2, skeleton=KIT21)], False),
    ):
        write_player(tmp_path / "p.html", motions)
        mesh = json.loads(Page(tmp_path / "p.html").texts["body"])
        assert (mesh is not None) == is_drawn


@pytest.mark.parametrize("tinted", [False, True])
def test_the_body_of_a_page_has_the_pixels_of_its_projected_triangles(tmp_path, tinted: bool):
    """Pictures have the same camera, light and rasterization, but other sizes."""
    motion = posed(1, heading=0.4, left_elbow=(0, -60, 0))
    write_player(tmp_path / "p.html", [motion])
    at, size, shown, halves = in_page(
        tmp_path / "p.html",
        f"element('tint').checked = {json.dumps(tinted)}; const m = motions[0]; strokes.length = 0;"
        " [m.canvas.width, m.canvas.height] = [150, 200]; draw(m, 0); const [points] = skinned(m, 0);"
        " Array.from({ length: mesh.count }, (_, v) => {"
        " const p = m.project(points[3 * v], points[3 * v + 1], points[3 * v + 2]);"
        " return [p.x, p.y, p.depth]; })",
        "strokes.find(({ name }) => name === 'drawImage').words.slice(1)",
        "[...new Uint32Array(strokes.find(({ name }) => name === 'putImageData').words[0].data.buffer)]",
        "Array.from({ length: mesh.count }, (_, v) => sideOf(motions[0], v))",
    )
    fitted, _ = motion.try_fit()
    assert fitted is not None
    _, normals = fitted.skinned(0)
    colors, points = fitted.mesh.colors, np.array(at)
    if tinted:
        side = np.array(halves)[:, None]
        ends = np.where(side > 0, SIDE_COLORS[1], SIDE_COLORS[-1])
        colors = np.array(SIDE_COLORS[0]) + np.abs(side) * (ends - np.array(SIDE_COLORS[0]))
    expected = np.zeros((200, 150, 3), np.uint8)
    shaded = render._shaded(normals, colors)
    render._rasterize(expected, points[:, :2], points[:, 2], shaded, fitted.mesh.triangles)
    left, top, width, height = size
    pixels = np.array(shown, np.uint32).view("u1").reshape(int(height), int(width), 4)
    drawn = np.zeros_like(expected)
    drawn[int(top) : int(top + height), int(left) : int(left + width)] = pixels[..., :3]
    body = expected.any(-1)
    assert body.sum() > 1000
    assert (drawn.any(-1) != body).sum() < 20
    difference = np.abs(drawn[body].astype(int) - expected[body])
    assert difference.mean() < 2
