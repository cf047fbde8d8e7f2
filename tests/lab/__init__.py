"""The laboratory: measurements of the method that no user needs.

Data flow: real and rendered pairs -> tables. The data set ``synthetic:N`` is registered for all of them.
"""

import tests.scenes.dataset  # noqa: F401  registers it
