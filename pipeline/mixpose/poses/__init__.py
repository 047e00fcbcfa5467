"""Write poses, read them back, and compare them with the truth.

`jsonl` writes and reads, `writers` has the formats of other programs and names all of them,
`evaluate` compares a poses file with a truth file and `report` shows the outcome.
"""
