"""The ledger: what the database knows and no other folder tells, written down as it is stored.

Run folders, experiments and analyses explain themselves. The ledger has the rest: the numbers of configurations with
their names, notes and groups, runs that wait, cells of experiments, evaluations, saved searches. Together they restore
every row (:mod:`slamhive.services.reindex`).
"""
