"""Where the cameras stand: given poses checked and refined, missing ones estimated.

Data flow: images, K and poses as given (or none) -> matches of points -> poses that fit them.
Paper: none; it takes exact poses for granted (S3.3).
"""
