"""Motion files for exchange with other programs. `docs/formats.md` lists units, axes and joints of each format."""

ENDINGS = (".npz", ".bvh", ".amc", ".json", ".npy")  # endings of motion files that are read
TREES = (".bvh", ".amc")  # those that contain a tree of joints and their rotations
WRITTEN = (".bvh", ".glb", ".npz", ".json", ".npy", ".gif", ".mp4")
"""Endings of the files that `flame_mdm.formats.motion.Motion.save` writes."""
