"""Reading BVH files with `flame_mdm.formats.bvh` and with the packages of PyPI, in one run.

    pip install bvhio bvhsdk
    python benchmarks/bvh.py FOLDER [number of files]

Reads the same files of FOLDER with each and prints milliseconds a file; packages that are not installed are left out.
`joints` is reading and forward kinematics, as far as a package has it.
"""

import importlib
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from flame_mdm.formats import bvh


def measure(name: str, read: Callable[[str], Any], paths: list[str]) -> None:
    start = time.perf_counter()
    for path in paths:
        read(path)
    print(f"{name:24} {1000 * (time.perf_counter() - start) / len(paths):8.1f} ms a file")


def package(name: str) -> Any | None:
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError:
        print(f"{name:24} not installed")
        return None


def joints_of_bvhio(bvhio: Any, path: str) -> list[list[Any]]:
    root = bvhio.readAsHierarchy(path)
    joints = [joint for joint, _, _ in root.layout()]
    poses = []
    first, last = root.getKeyframeRange()
    for frame in range(first, last + 1):
        root.loadPose(frame)
        poses.append([joint.PositionWorld for joint in joints])
    return poses


def main(folder: str, count: int) -> None:
    paths = sorted(map(str, Path(folder).rglob("*.bvh")))
    paths = paths[:: max(1, len(paths) // count)][:count]
    measure("flame_mdm", bvh.read, paths)
    measure("flame_mdm joints", lambda path: bvh.read(path).positions(), paths)
    if bvhio := package("bvhio"):
        measure("bvhio", bvhio.readAsBvh, paths)
        measure("bvhio joints", lambda path: joints_of_bvhio(bvhio, path), paths)
    if bvhsdk := package("bvhsdk"):
        measure("bvhsdk", bvhsdk.ReadFile, paths)


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]) if len(sys.argv) > 2 else 20)
