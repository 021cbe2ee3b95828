# The steps on processors: dg4d_lib and steps, no Prefect. Built from the root of the project by deploy/containers.sh.
# A package index of your own is a pip.conf, given as the secret `pip`; nothing of it stays in the image.
ARG PYTHON=python:3.11.16-slim-bookworm@sha256:528257d48c1da0dcecc2e725d1ae34498d60c965f1241e39cd6a85a8859bdf84

FROM ${PYTHON} AS packages
ARG TORCH_INDEX=https://download.pytorch.org/whl/cpu
WORKDIR /src
ENV PIP_NO_CACHE_DIR=1
COPY deploy/install.sh deploy/
COPY deploy/locks/steps.txt deploy/locks/torch.txt deploy/locks/
RUN --mount=type=secret,id=pip,target=/etc/pip.conf \
    python -m venv /opt/dg4d && VENV=/opt/dg4d bash deploy/install.sh torch steps

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
ENV PATH=/opt/dg4d/bin:$PATH PYTHONPATH=/opt/code
RUN python -c "import pymeshlab; assert len(pymeshlab.filter_list()) >= 281"
COPY --from=code /opt/code /opt/code
USER 10001
WORKDIR /home/dg4d
HEALTHCHECK --interval=60s --timeout=20s --start-period=20s --retries=3 CMD ["python", "-m", "steps.main", "--help"]
ENTRYPOINT ["python", "-m", "steps.main"]
