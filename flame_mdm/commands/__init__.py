"""Commands, one file each; `flame_mdm.__main__` lists them."""

from flame_mdm.config import EXPERIMENTS, Config
from flame_mdm.errors import UserError

OPTIONS = {
    "guidance_scale": "float",
    "sampler": "str",
    "num_inference_steps": "int | list[int]",
    "eta": "float",
    "spacing": "Literal['linspace', 'stride']",
}
"""Keys of `flame_mdm.batch.Sampling`, and the types of their values."""

SAMPLING = {"samples": "int", "seed": "int", **OPTIONS}
"""Keys that all sampling commands share, and the types of their values."""


def data_node(config: Config) -> Config:
    """Returns the data set of a command, with the path given as `source`.

    Raises:
        UserError: If no data set is named, or it takes no source.
    """
    if "data" not in config:
        names = sorted(path.stem for path in (EXPERIMENTS / "data").glob("*.yaml"))
        raise UserError(f"no data set named. Add data=NAME, one of: {', '.join(names)}; folder is for your own motions")
    node = config["data"]
    if config["source"] == "":
        raise UserError("source= is empty. Give the folder of the data set, or drop it")
    if config["source"] is not None:
        if "path" not in node["source"]:
            raise UserError(f"source={config['source']}: {node['name']} is generated and has no source. Drop source=")
        node["source"]["path"] = str(config["source"])
    return node
