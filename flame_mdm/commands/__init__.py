"""Commands, one file each; `flame_mdm.__main__` lists them."""

SAMPLING = {
    "samples": "int",
    "seed": "int",
    "guidance_scale": "float",
    "sampler": "str",
    "num_inference_steps": "int",
}
"""Keys that all sampling commands share, and the types of their values."""
