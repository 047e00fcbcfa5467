"""Write poses, read them back, and compare them with the truth.

`formats` names the writers (`jsonl`, `csvtable`, `ros`, `benchmarks`), `jsonl` also reads,
`evaluate` compares a poses file with a truth file and `report` shows the outcome.
"""
