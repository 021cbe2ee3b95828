# Prefect, the flows and the command `dg4d`, on top of an image of the steps: for a server, workers and runs of flows.
# Has the extras cluster, s3 and signing.
ARG STEPS=dg4d/cpu
FROM ${STEPS}
USER 0
# the code of all four packages, in the place of that of two
ENV PYTHONPATH="" DG4D_HOME=/home/dg4d/data PREFECT_HOME=/home/dg4d/data/prefect
WORKDIR /src
COPY deploy/install.sh deploy/
COPY deploy/locks/flows.txt deploy/locks/
COPY pyproject.toml README.md LICENSE ./
COPY dg4d_lib dg4d_lib
COPY steps steps
COPY flows flows
COPY dg4d dg4d
COPY deploy/pools.yaml deploy/prefect.yaml deploy/
# these folders belong to whoever runs here; a new volume that takes the place of one belongs to them too
RUN --mount=type=secret,id=pip,target=/etc/pip.conf \
    PIP_NO_CACHE_DIR=1 VENV=/opt/dg4d bash deploy/install.sh flows && \
    pip install --no-cache-dir --no-deps --no-build-isolation . && \
    python -m flows.serving.database_template && \
    rm -rf /src/* /opt/code && \
    install --directory --owner 10001 --group 10001 /home/dg4d/data /data
USER 10001
WORKDIR /home/dg4d
# whatever runs here needs the server
HEALTHCHECK --interval=30s --timeout=10s --start-period=60s --retries=3 CMD ["python", "-c", "import os, urllib.request as web; \
web.urlopen(os.environ.get('PREFECT_API_URL', 'http://127.0.0.1:4200/api') + '/health', timeout=5)"]
ENTRYPOINT []
CMD ["dg4d", "--help"]
