"""Commands, one file each; `flame_mdm.__main__` lists them."""

SAMPLING = {
    "samples": "int",
    "seed": "int",
    "guidance_scale": "float",
    "sampler": "str",
    "num_inference_steps": "int",
}
"""Kinds of values of the keys that all commands that sample take."""
