"""Poses on their way out, back in, and against the truth.

`formats` names the writers (`jsonl`, `csvtable`, `ros`, `benchmarks`), `jsonl` also reads,
`evaluate` compares a poses file with a truth file and `report` shows the outcome.
"""
