"""One guided denoising step: ``step`` is Algorithm 1's loop body, ``state`` what it carries along.

Data flow: the clean latent of a step -> relative map -> metric depth -> loss and correction -> what to add
to it.
Paper: Algorithm 1, S4.2.
"""
