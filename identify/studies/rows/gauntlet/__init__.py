"""Gauntlet: simulated laboratories in which something is wrong that the diagnosis must find.

A trouble is drawn, and a record is made with it. The plain model is identified and diagnosed. The
remedy is applied, and the model is identified again. The diagnosis is compared with the trouble.
"""
