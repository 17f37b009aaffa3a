# POUNCE (System 1): no simulator in it. Build from the repository root:
#     docker build -f docker/pounce.Dockerfile -t ponderpounce-pounce .
# PyPI's torch for Linux brings CUDA. For the much smaller CPU build say --build-arg TORCH_INDEX=URL with PyTorch's own
# index of CPU wheels (its "Get started" page names it).
FROM python:3.11-slim-bookworm

ARG TORCH=torch==2.13.0
ARG TORCH_INDEX=
RUN pip install --no-cache-dir ${TORCH_INDEX:+--index-url "$TORCH_INDEX"} "$TORCH"

WORKDIR /app
COPY pyproject.toml README.md requirements.txt ./
COPY protocol protocol
COPY clock clock
COPY dual_system dual_system
COPY model_server model_server
COPY pounce_server pounce_server
RUN pip install --no-cache-dir -c requirements.txt ".[serve]"

RUN useradd --no-create-home --uid 1000 ponderpounce
USER ponderpounce
ENV HOME=/tmp PYTHONUNBUFFERED=1 OMP_NUM_THREADS=1
ENTRYPOINT ["pounce-serve"]
