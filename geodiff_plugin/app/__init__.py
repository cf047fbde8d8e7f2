"""Serves the web app, ``geodiff app``: depth from two images, with measurements (requires the ``app`` extra).

Belongs here: the form, the page and its sessions, and the page of ``geodiff live``. Functionality shared with
the commands is in ``jobs``.
To extend: a field of the form is an option of ``jobs.options`` with an entry in ``form``.
Layer 12: imports ``jobs`` and below; only ``cli`` imports it, when it serves a page.
"""
