"""``geodiff info`` lists what the package has, without the imports that take seconds."""

import subprocess
import sys

from geodiff_plugin.cli.info import _adapters, run_info
from geodiff_plugin.priors import PRIORS


def test_the_adapters_are_those_of_the_table(capsys):
    assert _adapters() == list(PRIORS)
    run_info(None, None, False)
    printed = " ".join(capsys.readouterr().out.split())
    assert ", ".join(PRIORS) in printed and "geodiff-plugin" in printed and "torch" in printed


def test_it_imports_no_diffusers():
    code = (
        "import sys\nfrom geodiff_plugin.cli.info import run_info\nrun_info(None, None, False)\n"
        "assert not {'diffusers', 'transformers', 'kornia'} & set(sys.modules), 'slow'"
    )
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)
