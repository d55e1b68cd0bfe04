"""Pictures and videos of the hand. These are the ones of README and site.

grasp demo --video training/assets/hand.webp --task move --motion rotate --disturbance paper_path --seconds 4 --size 600 600
grasp demo --video training/assets/hand.png --task move --motion rotate --disturbance paper_path --seconds 0.6 --size 720 540
"""
