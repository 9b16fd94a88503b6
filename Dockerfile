# Installs the versions in constraints.txt and checks their hashes. docs/clusters.md explains how to build and
# use the image.
#   docker build -t flame-mdm .
#   docker build -t flame-mdm:cpu --build-arg TORCH_INDEX=https://download.pytorch.org/whl/cpu .
# The digest is Python 3.11.16 for all platforms. For a newer base: docker buildx imagetools inspect python:3.11-slim-bookworm
#   docker build -t flame-mdm --build-arg BASE=python:3.11-slim-bookworm@sha256:... .
ARG BASE=python:3.11-slim-bookworm@sha256:a36c24f9cbdf4fd0f52d67f0823eeac19c2028c637cecc392d97f980d4fec56b
FROM $BASE

# On PyPI, torch is built for CUDA and includes the CUDA libraries.
ARG TORCH_INDEX=https://pypi.org/simple

# torch.compile requires a C compiler, and a C++ compiler when training on a CPU.
# hadolint ignore=DL3008
RUN apt-get update \
    && apt-get install -y --no-install-recommends g++ gcc libc6-dev \
    && rm -rf /var/lib/apt/lists/*

WORKDIR /flame_mdm
COPY constraints.txt ./
# The torch index contains other versions of unrelated packages, so only torch is installed from it. The packages that
# torch requires are installed from PyPI below.
RUN pip install --no-cache-dir uv==0.13.9 \
    && uv pip install --system --no-cache --no-deps -c constraints.txt --default-index "$TORCH_INDEX" torch
COPY pyproject.toml README.md LICENSE ./
COPY flame_mdm flame_mdm
COPY evaluators evaluators
COPY experiments experiments
RUN uv pip install --system --no-cache -c constraints.txt ".[offline,slurm]"

# Data and runs are mounted; the container does not run as root.
RUN useradd --create-home --uid 1000 researcher && mkdir /workspace && chown researcher /workspace
USER 1000
WORKDIR /workspace
ENV FLAME_MDM_DATA=/workspace/data HF_HOME=/workspace/.cache/huggingface PYTHONUNBUFFERED=1
ENTRYPOINT ["flame-mdm"]
CMD ["--help"]
