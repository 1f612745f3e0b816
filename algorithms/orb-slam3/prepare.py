"""Run once when the image or environment is built: trains the small vocabulary that runs use by default."""

from slamhive.recordings.room.orb_vocabulary import prepare

if __name__ == "__main__":
    prepare()
