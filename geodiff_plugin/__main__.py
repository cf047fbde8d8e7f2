"""``python -m geodiff_plugin`` is the ``geodiff`` command (for ``accelerate launch`` and ``torchrun``)."""

from geodiff_plugin.cli.app import main

if __name__ == "__main__":
    main()
