"""Tests; a package so that fixtures can be imported."""
