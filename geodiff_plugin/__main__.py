"""``python -m geodiff_plugin`` is the ``geodiff`` command (for ``accelerate launch`` and ``torchrun``).

Layer 14: imports ``cli``.
"""

from geodiff_plugin.cli.app import main

if __name__ == "__main__":
    main()
