"""Tier 3. Beyond one machine, on Ray: experiments and actor hosts on the nodes of a cluster (docs/CLUSTER.md).

Ray is the optional extra `cluster`. Only functions import it, so nothing here needs it before it connects.
"""
