"""Commands, one file each; `flame_mdm.__main__` lists them."""

OPTIONS = {
    "guidance_scale": "float",
    "sampler": "str",
    "num_inference_steps": "int | list[int]",
    "eta": "float",
    "spacing": "Literal['linspace', 'stride']",
}
"""Keys of `flame_mdm.motion.Sampling`, and the types of their values."""

SAMPLING = {"samples": "int", "seed": "int", **OPTIONS}
"""Keys that all sampling commands share, and the types of their values."""
