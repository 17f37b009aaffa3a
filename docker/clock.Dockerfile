# The clock service, and every command that needs neither a model nor a simulator. Build from the repository root:
#     docker build -f docker/clock.Dockerfile -t ponderpounce-clock .
FROM python:3.11-slim-bookworm

WORKDIR /app
COPY pyproject.toml README.md requirements.txt ./
COPY protocol protocol
COPY clock clock
RUN pip install --no-cache-dir -c requirements.txt .

RUN useradd --no-create-home --uid 1000 ponderpounce
USER ponderpounce
ENV HOME=/tmp PYTHONUNBUFFERED=1
ENTRYPOINT ["clock-serve"]
