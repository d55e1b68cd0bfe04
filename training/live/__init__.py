"""`grasp live`: a grasp in the browser that people drag; the window knows nothing of grasps, the answers nothing of the page."""
