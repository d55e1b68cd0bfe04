"""`grasp live`: a grasp in the browser, to be pulled at; what is asked and answered (`question`, `playground`) knows nothing of the page."""
