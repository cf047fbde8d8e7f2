"""Implements phase 2, for a chunk of samples: guided denoising steps that change the latent (Algorithm 1).

Belongs here: the schedule of a call; ``guided_step`` and its parts (depth range, match fitting, loss terms,
the paper's optimizers); ``Member``, the outcome for one sample. Only this phase handles batches. To extend:
add a term as a function in ``terms`` and a row of ``TERMS``, or an optimizer as a row of
``optimizers.OPTIMIZERS``.
Layer 6: imports ``evidence``, ``scale``, ``matching`` and below; imported by ``result`` and ``runtime``.
"""
