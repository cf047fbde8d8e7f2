"""A page in the browser: photographs in, metric depth out, and a ruler on it (extra ``app``)."""
