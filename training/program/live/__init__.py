"""`grasp live`: an interactive grasp in the browser. `window` does not depend on grasps, `answer`
not on the page.
"""
