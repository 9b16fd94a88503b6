"""Motion files for exchange with other programs. `docs/formats.md` lists units, axes and joints of each format."""

from pathlib import Path

from flame_mdm.errors import UserError

ENDINGS = (".npz", ".bvh", ".amc", ".json", ".npy")  # of motion files that are read
TREES = (".bvh", ".amc")  # of those that contain a tree of joints and their rotations
USD = (".usda", ".usdc", ".usdz")  # Universal Scene Description
RIGGED = (".bvh", ".glb", ".fbx", *USD)  # of files that can have the skeleton of another program
WRITTEN = (*RIGGED, ".vrma", ".npz", ".json", ".npy", ".gif", ".mp4")  # of the files that `Motion.save` writes


def motion_files(folder: Path) -> list[Path]:
    """Returns the motion files in a folder and the folders below it, sorted."""
    files = sorted(file for file in folder.rglob("*") if file.suffix.lower() in ENDINGS and file.is_file())
    if not files:
        raise UserError(f"{folder}: no motion files ({', '.join(ENDINGS)})")
    return files
