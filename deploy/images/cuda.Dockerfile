# The steps on NVIDIA GPUs: as cpu.Dockerfile, with torch for CUDA 13, gsplat's kernels and the diffusion models.
# The kernels are compiled here, for the GPUs of $ARCHITECTURES, so the image needs no compiler when it runs.
ARG PYTHON=python:3.11.16-slim-bookworm@sha256:528257d48c1da0dcecc2e725d1ae34498d60c965f1241e39cd6a85a8859bdf84

FROM ${PYTHON} AS packages
ARG ARCHITECTURES="7.5 8.0 8.6 8.9 9.0 12.0"
WORKDIR /src
ENV PIP_NO_CACHE_DIR=1
COPY deploy/install.sh deploy/
COPY deploy/locks/steps.txt deploy/locks/cuda.txt deploy/locks/
RUN --mount=type=secret,id=pip,target=/etc/pip.conf \
    python -m venv /opt/dg4d && VENV=/opt/dg4d bash deploy/install.sh steps cuda
# hadolint ignore=DL3008
RUN apt-get update && apt-get install -y --no-install-recommends g++ && rm -rf /var/lib/apt/lists/*
COPY deploy/gsplat_kernels.py deploy/
RUN TORCH_CUDA_ARCH_LIST="${ARCHITECTURES}" PATH="/opt/dg4d/bin:$PATH" python deploy/gsplat_kernels.py && \
    /opt/dg4d/bin/pip uninstall --yes nvidia-cuda-nvcc nvidia-cuda-crt nvidia-nvvm nvidia-cuda-cccl

FROM packages AS code
COPY pyproject.toml README.md LICENSE ./
COPY deploy/pools.yaml deploy/prefect.yaml deploy/
COPY dg4d_lib dg4d_lib
COPY steps steps
# the command `dg4d` needs flows, which are not here, and they its data
RUN --mount=type=secret,id=pip,target=/etc/pip.conf \
    /opt/dg4d/bin/pip install --no-cache-dir --no-deps --no-build-isolation --target /opt/code . && rm -r /opt/code/bin /opt/code/share

FROM ${PYTHON}
# pymeshlab loads these two libraries; Debian keeps only their newest version, so none can be named
# hadolint ignore=DL3008
RUN apt-get update && \
    apt-get install -y --no-install-recommends libgl1 libopengl0 && \
    rm -rf /var/lib/apt/lists/* && \
    useradd --uid 10001 --create-home dg4d
COPY --from=packages /opt/dg4d /opt/dg4d
ENV PATH=/opt/dg4d/bin:$PATH PYTHONPATH=/opt/code \
    NVIDIA_VISIBLE_DEVICES=all NVIDIA_DRIVER_CAPABILITIES=compute,utility
RUN python -c "import pymeshlab; assert len(pymeshlab.filter_list()) >= 281"
COPY --from=code /opt/code /opt/code
USER 10001
WORKDIR /home/dg4d
HEALTHCHECK --interval=60s --timeout=20s --start-period=20s --retries=3 CMD ["python", "-m", "steps.main", "--help"]
ENTRYPOINT ["python", "-m", "steps.main"]
