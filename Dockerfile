# GViZDoom on CPU. Build: docker build -t gvizdoom .
# Run: mkdir -p runs; docker run --rm -it --init --shm-size=2g --user "$(id -u)" -v "$PWD/runs:/app/runs" \
#      gvizdoom train --config rainbow_4task
# Engines and rings live in /dev/shm: the default 64 MB of a container hold fewer than six games.
FROM python:3.11-slim-bookworm

WORKDIR /app
COPY requirements.lock ./
RUN pip install --no-cache-dir --no-deps -r requirements.lock
COPY pyproject.toml README.md LICENSE NOTICE ./
COPY gvz gvz
COPY actors actors
COPY learner learner
COPY configs configs
RUN pip install --no-cache-dir --no-deps --no-build-isolation . \
    && useradd --create-home --uid 1000 gvz && mkdir runs && chown gvz runs
# of any user that --user names, also one without a home
ENV HOME=/tmp
USER 1000
ENTRYPOINT ["gvz"]
CMD ["--help"]
