"""A page in the browser: photographs in, metric depth out, and a ruler on it.

Data flow: what a visitor gives -> ``GeometryGuidance`` -> guided call -> pictures, cloud, distances, files.
Paper: none; it shows what S5 measures.

``page`` and ``launch`` need the extra ``app`` (gradio); everything else here does not.
"""
