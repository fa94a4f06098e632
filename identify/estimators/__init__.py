"""Estimators on the same record, the project's own and those of the literature; none sees sensor or truth.

`evidence` says what each may use and returns, `registry` names them; `identify.estimator_comparison` judges them.
"""
