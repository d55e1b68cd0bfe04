"""`grasp live`: an interactive grasp in the browser."""
