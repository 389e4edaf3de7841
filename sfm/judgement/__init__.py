"""Judgement: what the image points say of a result, as remarks and a verdict.

`verdict.judge_survey` and `verdict.judge_adjustment` give a result its verdict. Each other module answers one
question. `checks`: how good are the observations? `bundle_statistics`: what do their tests say, and how well
does the network fit the given values? `calibrated_cameras`: how are the cameras calibrated? `cameras`: what
is remarkable about them? `model_choice` takes the likeliest of several models of the same image points.
`stated_precision`: do image points scatter as stated? `given`: are given values right?
"""
