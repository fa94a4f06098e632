"""Gauntlet: a laboratory in which something is wrong, which the diagnosis shall find.

A trouble is drawn, a record is made with it, the plain model is identified, diagnosed, remedied and
identified again. The drawn trouble is the truth with which the diagnosis is compared.
"""
