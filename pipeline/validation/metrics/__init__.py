"""How well detections fit the ground truth: overlap of boxes, average precision, and its standard error."""
