"""Makes ``python -m geodiff_plugin`` the ``geodiff`` command (for ``accelerate launch`` and ``torchrun``).

Layer 13: imports ``cli``.
"""

from geodiff_plugin.cli.app import main

if __name__ == "__main__":
    main()
