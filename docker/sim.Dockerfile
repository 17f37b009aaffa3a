# The simulated robot, its recorder and the viewer: no torch in it. Build from the repository root:
#     docker build -f docker/sim.Dockerfile -t ponderpounce-sim .
FROM python:3.11-slim-bookworm

# EGL without a screen for MuJoCo, and software Vulkan for rerun's pictures; pp-doctor looks for the same packages.
RUN apt-get update \
    && apt-get install -y --no-install-recommends \
        libegl1 libegl-mesa0 libgl1-mesa-dri libopengl0 mesa-vulkan-drivers \
    && rm -rf /var/lib/apt/lists/*

WORKDIR /app
COPY pyproject.toml README.md requirements.txt ./
COPY protocol protocol
COPY clock clock
COPY dual_system dual_system
COPY model_server model_server
COPY sim_client sim_client
RUN pip install --no-cache-dir -c requirements.txt ".[sim,replay]"
# Only its meshes are used. Its own pins contradict numpy 2, hence --no-deps.
RUN pip install --no-cache-dir --no-deps robosuite==1.5.2

RUN useradd --no-create-home --uid 1000 ponderpounce && mkdir /out && chown ponderpounce /out
USER ponderpounce
VOLUME /out
WORKDIR /out
ENV HOME=/tmp PYTHONUNBUFFERED=1 OMP_NUM_THREADS=1 MUJOCO_GL=egl
ENTRYPOINT ["sim-client"]
