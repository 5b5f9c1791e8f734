# `docker build -t realab . && docker run --rm -v "$PWD/out:/out" realab` trains
# an agent that tampers, and films it beside one that cannot, without a GPU.
FROM debian:bookworm-slim
# The versions of Debian's stable release do not change.
# hadolint ignore=DL3008
RUN apt-get update && apt-get install -y --no-install-recommends \
      python3-venv libegl1 libgl1 libgl1-mesa-dri libosmesa6 \
    && rm -rf /var/lib/apt/lists/* \
    && useradd --uid 1000 --create-home realab \
    && install -d -o realab /clone /out
USER 1000
WORKDIR /clone
COPY --chown=realab . .
RUN python3 -m venv /home/realab/venv \
    && /home/realab/venv/bin/pip install --no-cache-dir \
      -c constraints.txt '.[agents,report]'
ENV PATH=/home/realab/venv/bin:$PATH MUJOCO_GL=egl
WORKDIR /out
CMD ["realab", "demo", "--output=demo"]
