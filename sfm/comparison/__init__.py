"""Comparison of solutions: two adjusters on one network, a survey with a baseline, two results of one object.

- `adjusters.compare`, `adjusters.compare_adjusters`: two solutions of one network; begin here.
- `common_problem`, `unshared`, `camera_conversion`, `undistortion`: the same problem for both: equal weights,
  one camera model, image points without distortion.
- `significance.compare_results`: two results by names, aligned and tested.
- `baseline.compare_baseline`: a survey beside photographs oriented by another pipeline.
- `adjuster_validation.validate`: two adjusters over the networks of `random_network`.
"""
