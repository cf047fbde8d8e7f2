"""Runs a guided call of a live pipeline, from its arguments to its output, and leaves the pipeline unchanged.

The sequence, from top to bottom:

1. ``guided_call.GuidedCall.__call__`` binds the arguments of the stock call and starts phase 1 for every
   image in a thread (``evidence.plan``).
2. It enters a ``run.GuidedRun``, which attaches the hooks (``hooks``: the wrapped scheduler, images in
   float32, the denoiser's gradient), and runs the stock call.
3. The stock loop calls ``set_timesteps``, which makes the schedule (``GuidedRun.begin``), and ``step``, which
   guides (``GuidedRun.guide``: phase 2, ``algorithm.step``).
4. The stock call decodes through ``decode_prediction`` and reduces through ``ensemble_depth``, both in
   metres.
5. All hooks are removed, and phase 3 makes the output (``result.finish``, ``trust.judge``,
   ``result.output``).

Belongs here: hooks, noise levels, the codec and CUDA graphs. The arithmetic of the method does not.
Layer 8: imports the phases, ``priors`` and below; imported by ``capture`` and ``jobs``.
"""
