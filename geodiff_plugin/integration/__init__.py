"""The only place that touches a live pipeline: hooks, scheduler interception, offloading.

Hop: pipeline + guidance -> ``GuidedRun`` -> pipeline as it was found.
Paper: Algorithm 1, the lines around the gradient.
"""
