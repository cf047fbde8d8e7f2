"""The ``geodiff`` command with the renderer as the data set ``synthetic:N``.

python -m tests.scenes eval pairs synthetic:3
"""

import tests.scenes.dataset  # noqa: F401  registers it
from geodiff_plugin.__main__ import main

if __name__ == "__main__":  # `eval cost` starts processes, which read this file again
    main()
