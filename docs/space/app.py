"""Runs a public demo in a Hugging Face Space. README.md explains how to create one."""

import os

from flame_mdm.demo.app import serve

models = ["package", "package_dip"]
serve(models, host="0.0.0.0", port=7860, hosts=os.environ.get("SPACE_HOST", "").split())
