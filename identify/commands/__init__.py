"""Subcommands of ``cmmsim``. Heavy imports are late: ``--help`` must not wait for CasADi and
OpenGL.
"""
