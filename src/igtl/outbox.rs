//! What waits for one client: bounded for each kind of message of each device, so that a picture cannot push out a sentence.

use std::collections::VecDeque;
use std::sync::Arc;

use super::message::Message;

/// The limit is by these.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Channel {
    /// The message's type.
    pub type_name: &'static str,
    /// Its device.
    pub device: String,
}

impl Channel {
    /// Of a message.
    #[must_use]
    pub fn of(message: &Message) -> Self {
        Self { type_name: message.content.type_name(), device: message.device.clone() }
    }

    /// Messages that may wait: of a picture and of a state only the newest is worth the time of a slow client.
    #[must_use]
    pub fn most_waiting(&self) -> usize {
        match self.type_name {
            "IMAGE" | "STATUS" => 1,
            _ => 64,
        }
    }
}

/// Messages in the order in which they are sent.
#[derive(Debug, Default)]
pub struct Outbox {
    queue: VecDeque<(Channel, Arc<[u8]>)>,
    dropped: u64,
}

impl Outbox {
    /// Adds a message; where too many of its kind wait, the oldest of them goes.
    pub fn push(&mut self, channel: Channel, bytes: Arc<[u8]>) {
        let waiting = self.queue.iter().filter(|(known, _)| *known == channel).count();
        if waiting >= channel.most_waiting()
            && let Some(oldest) = self.queue.iter().position(|(known, _)| *known == channel)
        {
            self.queue.remove(oldest);
            self.dropped += 1;
        }
        self.queue.push_back((channel, bytes));
    }

    /// The message to be sent next.
    pub fn pop(&mut self) -> Option<Arc<[u8]>> {
        self.queue.pop_front().map(|(_, bytes)| bytes)
    }

    /// Whether nothing waits.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.queue.is_empty()
    }

    /// Messages that went for newer ones.
    #[must_use]
    pub fn dropped(&self) -> u64 {
        self.dropped
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn of_each_kind_the_newest_stay_and_the_others_are_counted() {
        let channel = |type_name, device: &str| Channel { type_name, device: device.to_owned() };
        let mut outbox = Outbox::default();
        outbox.push(channel("STRING", "Frame"), Arc::from([255]));
        for n in 0..100 {
            outbox.push(channel("TRANSFORM", "TipToLps"), Arc::from([n]));
            outbox.push(channel("IMAGE", "Drr"), Arc::from([100 + n]));
        }
        assert_eq!(outbox.dropped(), 36 + 99);
        let left: Vec<u8> = std::iter::from_fn(|| outbox.pop()).map(|bytes| bytes[0]).collect();
        assert_eq!(left[0], 255, "a sentence is not pushed out by others");
        assert_eq!(left[1..], (36..100).chain([199]).collect::<Vec<u8>>());
        assert!(outbox.is_empty());
    }
}
