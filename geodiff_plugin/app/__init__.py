"""A page in the browser: photographs in, metric depth out, and a ruler on it.

``page`` and ``launch`` need the extra ``app`` (gradio); everything else here does not.
"""
