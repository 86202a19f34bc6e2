"""All that actors and learner say to each other. Imports numpy, msgpack and the standard library only."""
