"""Streams endless motion, and changes its text while the stream runs."""

import sys

import flame_mdm

# A DiP model. `make train EXP=synthetic/dip` trains such a model without a download.
MODEL = sys.argv[1] if len(sys.argv) > 1 else "runs/synthetic/dip/default"

model = flame_mdm.load(MODEL)
stream = flame_mdm.stream(model, "a person walks forward", seed=0)
block = next(stream)
print(block)

stream.change("a person turns left")  # takes effect in the next block
for block in stream:  # continues the previous block in the world
    print(block, "until second", round(stream.frames / block.fps, 1))
    if stream.frames > 200:
        break
