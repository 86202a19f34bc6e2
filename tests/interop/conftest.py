"""These tests are another environment's, `make test-interop`: where its libraries are not, they are not collected."""

from importlib.util import find_spec

collect_ignore_glob = [] if find_spec("stable_baselines3") else ["test_*.py"]
