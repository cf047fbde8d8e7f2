"""Networks of other authors, as callables for ``examples.learned_stereo``."""
