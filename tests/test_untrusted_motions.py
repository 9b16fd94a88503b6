"""Crafted motion files, data folders and archives: refused in one line, at once, in little memory; nothing is left."""

import bz2
import gzip
import hashlib
import io
import json
import lzma
import os
import pickle
import re
import signal
import struct
import tarfile
import time
import tracemalloc
import zipfile
from collections.abc import Callable, Iterator
from itertools import product
from multiprocessing import active_children
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

import numpy as np
import pytest
from support.motions import adult, bvh_text
from support.refusals import Refused, bounded, carry_out, npz
from support.runs import no_children

from evaluators.sources import read_samples
from flame_mdm.data import archives, restricted_pickle
from flame_mdm.data.amass import read as read_amass
from flame_mdm.data.bandai import Bandai
from flame_mdm.data.folder import Folder
from flame_mdm.data.humanact12 import HumanAct12
from flame_mdm.data.parallel import in_order
from flame_mdm.data.store import Store
from flame_mdm.errors import UserError
from flame_mdm.formats import asf, resampling
from flame_mdm.formats import bvh as bvh_files
from flame_mdm.formats.readers import read
from flame_mdm.safe_io import (
    MEBIBYTE,
    check_expansion,
    check_members,
    read_npz,
    read_yaml,
    regular_file,
    sha256,
)

pytestmark = pytest.mark.slow


def header(shape: tuple[int, ...], dtype: str = "<f8") -> bytes:
    """The header of an .npy file that declares any shape."""
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        stream, {"descr": dtype, "fortran_order": False, "shape": shape}
    )
    return stream.getvalue()


def zipped(members: dict[str, bytes], method: int = zipfile.ZIP_DEFLATED) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", method) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return stream.getvalue()


def encrypted(data: bytes) -> bytes:
    """A zip archive whose headers say that its members are encrypted."""
    for magic, at in ((b"PK\3\4", 6), (b"PK\1\2", 8)):
        head, *members = data.split(magic)
        data = head + b"".join(
            magic + part[: at - 4] + b"\1\0" + part[at - 2 :] for part in members
        )
    return data


def bvh_at(seconds: str) -> bytes:
    return bvh_text().replace("Frame Time: 0.05", f"Frame Time: {seconds}").encode()


JOINTS = adult(4).astype(float)
LONG = np.zeros((4, 156), np.longdouble)
FIELDS = np.zeros((4, 147), [("a", "f4")])
BOMB = zipped({"joints.npy": header((260_000, 22, 3)) + bytes(260_000 * 528)})  # 131 MiB
MOTIONS: list[tuple[str, bytes, str]] = [
    ("a.bvh", bvh_at("999999"), "frame time"),
    ("a.bvh", bvh_at("0.0000011"), "frame time"),
    ("a.bvh", bvh_text().replace("Frames: 3", "Frames: 1000000000").encode(), "1000000000"),
    ("a.bvh", bvh_at("1" * 40_000 + "x"), "Frame Time"),
    ("a.npz", b"PK\x03\x04 cut", "damaged"),
    (
        "a.npz",
        npz(poses=LONG, trans=np.zeros((4, 3)), mocap_framerate=20),
        "poses must be an array of real numbers",
    ),
    (
        "a.npz",
        npz(joints=JOINTS, fps=20, representation="smpl147", features=FIELDS),
        "features must be an array",
    ),
    ("a.npz", zipped({"joints.npy": header((10**12, 22, 3)), "fps.npy": b"x"}), "declares"),
    ("a.npz", BOMB, "expand to"),
    ("a.npz", encrypted(npz(joints=JOINTS, fps=20)), "encrypted"),
    (
        "a.npz",
        zipped({"joints.npy": header((4, 22, 3))}, zipfile.ZIP_LZMA),
        "a method other than deflate",
    ),
    ("a.npz", npz(joints=np.array([{}]), fps=20), "Python objects"),
    ("a.npy", header((10**12, 22, 3)), "declares"),
    ("a.npy", header((2**62, 2**62)), "declares"),
    ("a.npy", b"\x93NUMPY\x01\x00" + struct.pack("<H", 60000) + b"(" * 60000, "not an array"),
    ("a.npy", b"\x93NUMPY\x01\x00" + struct.pack("<H", 60) + b"(" * 60, "not an array"),
    ("a.json", b'{"joints": ' + b"[" * 10**6, "nested too deeply"),
    ("a.json", b"[1, 2]", "not a JSON motion"),
    ("a.json", json.dumps({"fps": 1e-7, "joints": JOINTS.tolist()}).encode(), "fps is 1e-07"),
    ("a.json", b"\xff\xfe{}", "a.json: not a UTF-8 text file"),
]
TABLES: list[tuple[str, bytes, str]] = [
    ("skeleton.yaml", b"a: &x [*x]", "skeleton.yaml"),
    ("skeleton.yaml", b"[" * 10**5, "skeleton.yaml"),
    ("skeleton.yaml", b"map: \xff", "skeleton.yaml: not a UTF-8"),
    ("skeleton.yaml", b"fps: 1.0e-7", "skeleton.yaml: fps"),
    ("skeleton.yaml", b"joints: [[a], [b]]", "skeleton.yaml: joints"),
    ("skeleton.yaml", b"map: {pelvis: [a]}", "skeleton.yaml: map"),
    ("skeleton.yaml", b"map: {pelvis: {a: x}}", "skeleton.yaml: map"),
    ("captions.csv", b"id,text\na," + b"x" * 200_000, "captions.csv: damaged"),
    ("captions.csv", b"i\0d,text\n", "captions.csv"),
    ("captions.csv", b"id,text\na,\xff\n", "captions.csv: not a UTF-8"),
    ("a.txt", b"\xff\n", "a.txt: not a UTF-8"),
]


def refuses(says: str, call: Callable[..., object], *arguments: Any, **options: Any) -> None:
    """A call on bad input raises an error of the user's in one line, in little time and memory."""
    with bounded(), pytest.raises((UserError, OSError), match=re.escape(says)) as error:
        call(*arguments, **options)
    assert len(str(error.value).splitlines()) == 1, says


def of_folder(folder: Path) -> None:
    """Reads the motions of a folder, whose failures are listed while the others are prepared."""
    source = Folder(str(folder), workers=1)
    list(source.clips(20.0))
    source.require_all()


@pytest.fixture
def folder(tmp_path: Path) -> Callable[[Callable[[Path], Any]], Path]:
    """Makes folders of two motions after a change."""

    def make(change: Callable[[Path], Any]) -> Path:
        path = Path(mkdtemp(dir=tmp_path))
        for name in "ac":
            np.savez(path / f"{name}.npz", joints=adult(60), fps=20.0)
        change(path)
        return path

    return make


def test_motion_files_and_tables_of_data_folders_are_refused(tmp_path: Path, folder: Callable):
    for name, content, says in MOTIONS:
        path = tmp_path / name
        path.write_bytes(content)
        refuses(says, read, path, fps=20 if name == "a.npy" else None)
    for name, content, says in [("b.npz", BOMB, "expand to"), *TABLES]:
        refuses(says, of_folder, folder(lambda path, n=name, c=content: (path / n).write_bytes(c)))


def test_commands_refuse_in_one_line_and_leave_nothing(attacked: Refused, bad: Path, trained: Path):
    root = bad.parent / "prepared"
    attacked.watched.append(root)
    (bad / "a.npz").write_bytes(BOMB)
    attacked("convert", str(bad / "a.npz"), "out=out.json", says="expand to")
    attacked(
        "edit",
        f"ckpt={trained}",
        f"motion={bad / 'a.npz'}",
        "region=in_between",
        "text=a",
        says="expand to",
    )
    attacked("prepare", "data=folder", f"source={bad}", f"data_root={root}", says="expand to")
    (bad / "set").write_bytes(sparse(TAKE, 40 * 10**9))
    words = (f"source={bad / 'set'}", f"data_root={root}", "data.source.workers=1")
    attacked("prepare", "data=bandai", *words, says="sparse")
    (bad / "humanact12poses.pkl").write_bytes(PICKLES["doubled"][0])
    attacked(
        "prepare",
        "data=humanact12",
        f"source={bad / 'humanact12poses.pkl'}",
        f"data_root={root}",
        says="expand",
    )


def test_links_pipes_and_folders(tmp_path: Path, folder: Callable):
    os.mkfifo(tmp_path / "pipe")
    for ending in ("npz", "bvh", "npy", "json"):
        for number, target in enumerate((tmp_path / "pipe", "/dev/zero", "loop", tmp_path)):
            path = tmp_path / f"{number}.{ending}"
            path.symlink_to(path if target == "loop" else target)
            refuses(str(path), read, path, fps=20)
    for name in ("b.npz", "a.txt", "captions.csv", "skeleton.yaml"):
        refuses(
            f"{name}: this is a pipe",
            of_folder,
            folder(lambda path, name=name: os.mkfifo(path / name)),
        )
    of_folder(folder(lambda path: (path / "b.npz").mkdir()))  # is no motion
    refuses(
        "b.npz: cannot be read",
        of_folder,
        folder(lambda path: (path / "b.npz").symlink_to(path / "b.npz")),
    )
    for name, shown in ((b"\x1b[31m", r"\x1b[31m"), (b"\xff", r"\udcff"), (b"x\ny", r"x\ny")):
        path = folder(
            lambda path, name=name: Path(
                os.fsdecode(os.fsencode(path) + b"/" + name + b".npz")
            ).touch()
        )
        refuses(shown, of_folder, path)


def test_long_motions_are_not_resampled_without_end(subtests):
    for rate, fps, joints in ((0.1, 20, 22), (1, 1000, 22), (1, 20, 5000)):
        with (
            subtests.test(rate=rate, fps=fps, joints=joints),
            pytest.raises(ValueError, match="would become"),
        ):
            resampling.frame_pairs(10_000, rate, fps, joints)
    with pytest.raises(ValueError, match="at most 500,000"):
        resampling.frame_pairs(10**6, 120, 20, 22)
    assert len(resampling.frame_pairs(432_000, 120, 20, 52)[0]) == 72_000  # an hour
    assert len(resampling.frame_pairs(3, 0.1, 20, 22)[0]) == 401


TAKE = "dataset-1_walk_happy_001.bvh"


def member(name: str, size: int = 0, kind: bytes = tarfile.REGTYPE, link: str = "") -> bytes:
    """The header of a member of a tar archive that declares any size."""
    info = tarfile.TarInfo(name)
    info.size, info.type, info.linkname = size, kind, link
    return info.tobuf(tarfile.GNU_FORMAT)


def sparse(name: str, size: int) -> bytes:
    """1,536 bytes of a tar archive, in which a file has any size."""
    data = bytearray(member(name, 0, tarfile.GNUTYPE_SPARSE))
    data[386:398] = b"00000000000\0"
    data[483:495] = b"\x80" + size.to_bytes(11, "big")
    data[148:156] = b" " * 8
    data[148:156] = b"%06o\0 " % sum(data)
    return bytes(data) + bytes(1024)


def archive_cases() -> Iterator[tuple[bytes, str]]:
    whole = bvh_text().encode()
    yield sparse(TAKE, 40 * 10**9), "sparse"
    yield member(TAKE, 10**12) + bytes(1024), "too large for a motion"
    yield member("junk", 10**12) + bytes(1024), "damaged archive"
    for target in (TAKE, "/etc/passwd", "../../x", "none"):
        for kind in (tarfile.SYMTYPE, tarfile.LNKTYPE):
            yield member(TAKE, 0, kind, target) + bytes(1024), "a link"
    yield member(TAKE, 0, tarfile.FIFOTYPE) + bytes(1024), "special file"
    yield member("@LongLink", 10**10, tarfile.GNUTYPE_LONGNAME) + bytes(1024), "a header is"
    yield member("x", 10**10, tarfile.XHDTYPE) + bytes(1024), "a header is"
    for kind, values, says in (
        (tarfile.XGLTYPE, 200, "not a BVH file"),
        (tarfile.XHDTYPE, 10_000, "a header is"),
    ):
        records = b"".join(
            b"%d k%d=v\n" % (len(f"k{n}=v\n") + 3, n) for n in range(10_000, 10_000 + values)
        )
        padding = bytes(-len(records) % tarfile.BLOCKSIZE)
        yield member("x", len(records), kind) + records + padding + member(TAKE) + bytes(1024), says
    for compress, name in product((gzip.compress, bz2.compress, lzma.compress), (TAKE, "junk")):
        yield compress(member(name, 8 * MEBIBYTE) + bytes(8 * MEBIBYTE)), "expand to"
    yield zipped({TAKE: bytes(8 * MEBIBYTE)}), "expand to"
    yield zipped({f"{TAKE}{n}": bytes(3 * MEBIBYTE) for n in range(2)}), "expand to"
    yield encrypted(zipped({TAKE: whole})), "encrypted"
    yield zipped({TAKE: whole}, zipfile.ZIP_LZMA), "a method other than deflate"
    yield zipped({TAKE: whole})[:-30], "damaged archive"
    yield b"PK\3\4", "damaged archive"
    yield (
        zipped({"-" + TAKE: whole}).replace(b"-" + TAKE.encode(), b"\0" + TAKE.encode()),
        "a file without a name",
    )
    yield b"", "neither a folder nor"
    yield bytes(10240), "no file dataset-1"


def test_archives_are_refused_and_many_members_take_little_memory(tmp_path: Path, monkeypatch):
    monkeypatch.setattr("flame_mdm.safe_io.ARRAYS_LIMIT", 4 * MEBIBYTE)  # packing more takes long
    path = tmp_path / "set"
    for content, says in archive_cases():
        path.write_bytes(content)
        refuses(says, lambda: list(Bandai(str(path), workers=1).clips(20)))
    monkeypatch.undo()
    path = tmp_path / "a.tar.gz"
    path.write_bytes(gzip.compress(member("x") * 20_000 + bytes(1024)))
    tracemalloc.start()
    try:
        assert sum(1 for _ in archives.members(path, lambda name: True)) == 20_000
        assert tracemalloc.get_traced_memory()[1] < 4 * MEBIBYTE
    finally:
        tracemalloc.stop()


def test_archives_of_too_many_members_are_refused_before_they_are_listed(
    tmp_path: Path, monkeypatch
):
    names = [f"{number}.txt" for number in range(1000)]
    cases = {"a.zip": zipped(dict.fromkeys(names, b"")), "a.tar": member("x") * 1000 + bytes(1024)}
    cases["a.npz"] = npz(**{f"a{number}": np.zeros(0) for number in range(1000)})
    made = []

    class Counted(zipfile.ZipInfo):
        def __init__(self, *words: Any):
            made.append(words)
            super().__init__(*words)

    monkeypatch.setattr(zipfile, "ZipInfo", Counted)
    for name, content in cases.items():
        (tmp_path / name).write_bytes(content)
    listed = {
        "a.zip": lambda: list(archives.members(tmp_path / "a.zip", lambda name: False)),
        "a.tar": lambda: list(archives.members(tmp_path / "a.tar", lambda name: False)),
        "a.npz": lambda: read_npz(tmp_path / "a.npz"),
    }
    for read_archive in listed.values():
        read_archive()  # a thousand are allowed
    monkeypatch.setattr("flame_mdm.safe_io.MAX_MEMBERS", 999)
    for read_archive in listed.values():
        refuses("more than 999 files", read_archive)
    made.clear()
    monkeypatch.setattr("flame_mdm.safe_io.DIRECTORY_LIMIT", 1000)
    for name in ("a.zip", "a.npz"):
        refuses("more than 999 files", listed[name])
    assert made == []


def test_the_limits_of_files_are_the_largest_sizes_that_are_read(tmp_path: Path):
    path = tmp_path / "a.txt"
    path.write_bytes(b"x" * 1010)
    assert regular_file(path, 1010) == 1010
    refuses(
        "the file is 0.986 KiB, but at most 0.985 KiB is allowed", lambda: regular_file(path, 1009)
    )
    check_members(200_000)
    refuses("more than 200,000 files", lambda: check_members(200_001))
    for packed in (1, 10 * MEBIBYTE):
        most = max(128 * MEBIBYTE, 20 * packed)
        check_expansion(most, packed)
        refuses("expand to", lambda packed=packed, most=most: check_expansion(most + 1, packed))
    path = tmp_path / "a.yaml"
    path.write_text(f"a: {10**19}")  # 20 digits
    assert read_yaml(path) == {"a": 10**19}


def wide_bvh(joints: int, frames: int) -> bytes:
    """A motion of joints without channels below a root with one channel: two bytes per frame."""
    below = "JOINT j\n{\nOFFSET 0 1 0\nCHANNELS 0\nEnd Site\n{\nOFFSET 0 1 0\n}\n}\n" * (
        joints // 2
    )
    head = f"HIERARCHY\nROOT r\n{{\nOFFSET 0 0 0\nCHANNELS 1 Yposition\n{below}}}\n"
    return f"{head}MOTION\nFrames: {frames}\nFrame Time: 0.05\n".encode() + b"0\n" * frames


def wide_amc(folder: Path, bones: int, frames: int) -> Path:
    """A motion of bones without degrees of freedom, each the child of the root."""
    data = "".join(
        f"begin\nname b{n}\ndirection 0 1 0\nlength 1\naxis 0 0 0 XYZ\nend\n" for n in range(bones)
    )
    tree = "".join(f"root b{n}\n" for n in range(bones))
    (folder / "1.asf").write_text(
        f":root\norder TY\naxis XYZ\n:bonedata\n{data}:hierarchy\nbegin\n{tree}end\n"
    )
    path = folder / "1_1.amc"
    path.write_text("".join(f"{frame}\nroot 0\n" for frame in range(1, frames + 1)))
    return path


def test_frames_times_joints_are_bounded_before_memory_is_taken(tmp_path: Path, folder: Callable):
    path = tmp_path / "wide.bvh"
    path.write_bytes(wide_bvh(4000, 10_000))
    assert path.stat().st_size < 200_000
    with (
        bounded(20, 200 * MEBIBYTE),
        pytest.raises(UserError, match="a file of this size may have at most 249 frames"),
    ):
        bvh_files.read(path)
    amc = wide_amc(tmp_path, 2000, 4000)
    with (
        bounded(20, 200 * MEBIBYTE),
        pytest.raises(UserError, match=r"1_1\.amc: 4,001 frames of 4,001 joints"),
    ):
        asf.read(amc, 120)


def test_long_motions_of_many_moving_joints_are_read(tmp_path: Path):
    """A minute of 300 joints: 2 million positions are more than a small file may have, but its numbers are there."""
    body = "".join(
        f"JOINT j{n}\n{{\nOFFSET 0 1 0\nCHANNELS 3 Zrotation Xrotation Yrotation\n"
        for n in range(300)
    )
    text = f"HIERARCHY\nROOT r\n{{\nOFFSET 0 0 0\nCHANNELS 3 Xposition Yposition Zposition\n{body}{'}' * 301}\n"
    text = text.replace("}", "}\n") + "MOTION\nFrames: 7200\nFrame Time: 0.00833333\n"
    path = tmp_path / "long.bvh"
    path.write_text(text + (" ".join(["0.5"] * 903) + "\n") * 7200)
    read_back = bvh_files.read(path)
    assert read_back.frames.shape == (7200, 903)
    assert len(read_back.joints) * len(read_back.frames) > resampling.FEW_POSITIONS


def test_the_bones_of_an_asf_file_are_bounded(tmp_path: Path):
    assert len(asf.read(wide_amc(tmp_path, 1000, 3), 120).joints) == 2001  # each bone has an end
    refuses("more than 4096 bones", asf.read, wide_amc(tmp_path, 50_000, 3), 120)


@pytest.mark.parametrize(
    ("case", "says"), [("killed", "a worker process was killed"), ("bomb", "frame time")]
)
def test_one_bad_task_ends_all_workers(case: str, says: str, tmp_path: Path):
    (tmp_path / "bomb").write_bytes(bvh_at("999999"))
    tasks: dict[str, list[tuple]] = {"killed": [(abs, 1), (signal.raise_signal, 9)]}
    # The first one has no end.
    tasks["bomb"] = [
        (signal.raise_signal, signal.SIGSTOP),
        (bvh_files.read, tmp_path / "bomb"),
    ]
    before, start = active_children(), time.monotonic()
    with pytest.raises((UserError, ValueError), match=says):
        list(in_order(carry_out, [*tasks[case], *[(abs, -2)] * 9], workers=2))
    assert no_children(before)
    assert time.monotonic() - start < 60  # most of it for the processes to start


PICKLES = {
    "bytes": (b"\x80\x04\x8e" + struct.pack("<Q", 10**12) + b"x.", "too early"),
    "frame": (b"\x80\x04\x95" + struct.pack("<Q", 10**12) + b"N.", "too early"),
    "memo": (b"\x80\x04Nr\xff\xff\xff\x7f.", "must contain"),
    "tuples": (b"\x80\x04})" + b"\x85" * (2 * 10**5) + b"Ns.", "is not text"),
    "lists": (b"\x80\x04" + b"](" * 10**5 + b"e" * 10**5 + b".", "nested too deeply"),
    # A list that holds a list twice, which holds a list twice, and so on.
    "doubled": (
        b"\x80\x04]" + b"q\x00](h\x00h\x00e" * 60 + b".",
        "expand to",
    ),
    "cycle": (b"\x80\x04]\x94h\x00a.", "nested too deeply"),
    "integers": (pickle.dumps({n * (2**61 - 1): 0 for n in range(2**10)}, 4), "is not text"),
    "complex": (
        pickle.dumps({complex(-1_000_003 * n, n): 0 for n in range(1, 2**10)}, 4),
        "it refers to builtins.complex",
    ),
    "frozen": (pickle.dumps(frozenset([(1, 2), (3, 4)]), 4), "a set"),
    "old dictionary": (b"((I1\nI2\ntI3\nd.", "is not text"),
    "digits": (b"L" + b"9" * 30 + b"L\n.", "must contain"),
    "attributes": (b"\x80\x04c_codecs\nencode\n}\x8c\x01aNsb.", "sets attributes"),
}


def test_pickles_are_refused_or_bounded(tmp_path: Path):
    path = tmp_path / "humanact12poses.pkl"
    wrong: list[list[Any]] = [
        [3, 3, 3],
        [["x"], ["x"], [1]],
        [[np.zeros((2, 72))], [np.zeros((2, 24, 3))], ["x"]],
    ]
    dictionaries = [dict(zip(("poses", "joints3D", "y"), values, strict=True)) for values in wrong]
    for content, says in (
        *PICKLES.values(),
        *((pickle.dumps(content), str(path)) for content in dictionaries),
    ):
        path.write_bytes(content)
        refuses(says, lambda: list(HumanAct12(str(path)).clips(20)))
    array = np.zeros(10**6, np.uint8)  # repeated arrays count each time
    (tmp_path / "few.pkl").write_bytes(pickle.dumps([array] * 5))
    assert len(restricted_pickle.read(tmp_path / "few.pkl")) == 5
    (tmp_path / "many.pkl").write_bytes(pickle.dumps([array] * 1000))
    with pytest.raises(ValueError, match="expand to"):
        restricted_pickle.read(tmp_path / "many.pkl")


def small_store(folder: Path, clip: dict[str, Any], info: dict[str, Any]) -> None:
    """Writes a store of one clip with changed fields; its hashes and its fingerprint are right."""
    entry: dict[str, Any] = {
        "id": "a",
        "start": 0,
        "length": 4,
        "split": "train",
        "source": "a",
        "captions": [],
    }
    entry |= {"action": None, "attributes": {}} | clip
    folder.mkdir(parents=True, exist_ok=True)
    np.save(folder / "features.npy", np.zeros((4, 2), np.float32))
    (folder / "clips.jsonl").write_text(json.dumps(entry) + "\n")
    np.savez(folder / "statistics.npz", mean=np.zeros(2, np.float32), std=np.ones(2, np.float32))
    hashes = {path.name: sha256(path) for path in folder.iterdir() if path.suffix != ".json"}
    digest = hashlib.sha256(
        (folder / "clips.jsonl").read_bytes() + b'["r", 20, [0.0, 0.0, 1.0, 1.0]]'
    )
    content: dict[str, Any] = {
        "format": 1,
        "dataset": "d",
        "representation": "r",
        "fps": 20,
        "hours": 0.1,
    }
    content |= {
        "actions": ["x"],
        "excluded": {},
        "published_split": False,
        "shape": [4, 2],
        "sha256": hashes,
    }
    content |= {"clips": {"train": 1, "val": 0, "test": 0}, "fingerprint": digest.hexdigest()[:16]}
    (folder / "store.json").write_text(json.dumps(content | info))


CLIPS = {
    "action": [99, -1, "a", {}],
    "id": [5, ""],
    "captions": [None, [5]],
    "start": [3.5, -1],
    "length": [0, 5],
}
CLIPS |= {"source": [1], "split": [[]], "attributes": [[]]}
COUNTS = {"train": 1, "val": 0, "test": 0}
INFOS = [
    ("hours", 10**400),
    ("fps", 10**400),
    ("clips", COUNTS | {"<b>x": 1}),
    ("clips", COUNTS | {"val": "x"}),
]
INFOS += [("clips", {"train": 1}), ("actions", [1])]


def opened(folder: Path) -> None:
    store = Store(folder)
    store.motion(store.clips[0])


def test_every_field_of_a_store_is_checked(tmp_path: Path):
    small_store(tmp_path, {"action": 0}, {})
    Store(tmp_path).verify()
    for name, value in [(name, value) for name, values in CLIPS.items() for value in values]:
        small_store(tmp_path, {name: value}, {})
        refuses("clips.jsonl is damaged: line 1: ", opened, tmp_path)
    for name, value in INFOS:
        small_store(tmp_path, {}, {name: value})
        refuses("store.json is damaged: ", opened, tmp_path)
    small_store(tmp_path, {}, {"fingerprint": "0123456789abcdef"})
    refuses("store.json is damaged: its fingerprint", opened, tmp_path)
    for content in (zipped({"a.npy": b"x"}), header((2**70, 263), "<f4"), header((-1, 263), "<f4")):
        small_store(tmp_path, {}, {})
        (tmp_path / "features.npy").write_bytes(content)
        refuses("features.npy is damaged", opened, tmp_path)


def test_samples_of_other_kinds_and_recordings_of_amass_are_bounded(tmp_path: Path, subtests):
    path = tmp_path / "a.npz"
    whole: dict[str, Any] = {
        "ids": np.array(["a"]),
        "lengths": np.array([4]),
        "features": np.zeros((4, 2)),
    }
    path.write_bytes(npz(**whole, captions=np.array(["x"])))
    assert read_samples(path)["lengths"].tolist() == [4]
    arrays = [
        np.zeros((4, 2, 3)),
        np.zeros(()),
        np.zeros((4, 2), np.longdouble),
        np.zeros((4, 66)),
        np.array([1]),
    ]
    for name, array in zip(["features"] * 3 + ["joints", "captions"], arrays, strict=True):
        path.write_bytes(npz(**whole | {name: array}))
        refuses("a.npz: ", read_samples, path)
    whole = {
        "poses": np.zeros((4, 156)),
        "trans": np.zeros((4, 3)),
        "betas": np.zeros(16),
        "gender": "male",
    }
    wrong: dict[str, list[Any]] = {
        "mocap_framerate": [np.inf, 1e-7, [1, 2]],
        "gender": [np.array(["a", "b"])],
    }
    wrong |= {
        "betas": [np.array(["x"]), np.zeros(())],
        "poses": [np.zeros((4, 156), "S1"), np.zeros(())],
    }
    for name, value in [(name, value) for name, values in wrong.items() for value in values]:
        with subtests.test(name=name), pytest.raises(UserError, match="here: "):
            read_amass(npz(**{**whole, "mocap_framerate": 120.0, name: value}), "here")
