"""Planning: what a network must be like before anything is photographed.

- `sight.visibility.sight_of`: which point is seen from where, and how precisely.
- `prediction.predict_network`: what photographs from given stations will give.
- `design.designer.design_network`: stations that give what is wanted.
- `plan.plan_of`: all that is said of a plan.
- `target_size.target_size`: how large targets must be.
"""
