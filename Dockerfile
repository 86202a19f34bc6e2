# GViZDoom on CPU. Build: docker build -t gvizdoom .
# Run: docker run --rm --shm-size=2g -v "$PWD/runs:/app/runs" gvizdoom --config rainbow_4task.py
# Engines and rings live in /dev/shm: the default 64 MB of a container hold fewer than six games.
FROM python:3.11-slim-bookworm

RUN useradd --create-home --uid 1000 gvz && mkdir -p /app/runs && chown -R gvz /app
WORKDIR /app
COPY requirements.lock ./
RUN pip install --no-cache-dir --no-deps -r requirements.lock
COPY pyproject.toml README.md LICENSE ./
COPY gvz gvz
COPY actors actors
COPY learner learner
COPY configs configs
RUN pip install --no-cache-dir --no-deps --no-build-isolation .
USER gvz
ENTRYPOINT ["python", "-m", "gvz.launch"]
CMD ["--config", "rainbow_4task.py"]
