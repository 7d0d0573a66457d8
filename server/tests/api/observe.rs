//! Observing: what a belief tells, that steps come once and in order, and the control loop.

use base64::{Engine as _, prelude::BASE64_STANDARD};
use gatsbi_proto::v1::{self, Encoding, Output, image::Content, observe_stream_response::Result};
use serde_json::json;
use tokio_stream::wrappers::ReceiverStream;
use tonic::Code;
use tonic_types::StatusExt as _;

use crate::support::{
    TestServer, actions, f32_tensor, floats, observation, outputs, picture, tensor, u8_image,
};

#[tokio::test]
async fn a_belief_tells_what_was_asked_and_nothing_else() {
    let server = TestServer::start().await;
    let session = server.seasoned(4, 1).await;
    let all = [
        Output::Frame,
        Output::AgentMask,
        Output::SlotMasks,
        Output::ObjectMasks,
        Output::Background,
        Output::Objects,
        Output::Latents,
        Output::Surprise,
        Output::LogLikelihood,
        Output::Keypoints,
    ];
    let mut request = observation(&session, 1);
    request.outputs = Some(outputs(&all, Encoding::F32));
    let belief = server.observe(request).await.unwrap();
    assert_eq!((belief.step, belief.predicted, belief.repeated), (1, false, false));
    assert_eq!(belief.outputs.len(), all.len() - 1, "objects have a field of their own");
    let shape = |output| tensor(&belief.outputs, output).shape.clone();
    assert_eq!(shape(Output::Frame), [64, 64, 3]);
    assert_eq!(shape(Output::AgentMask), [64, 64]);
    assert_eq!(shape(Output::Latents), [858]);
    assert_eq!(shape(Output::Surprise), Vec::<u32>::new());
    assert_eq!(shape(Output::Keypoints), [12, 3]);
    let slots = floats(tensor(&belief.outputs, Output::SlotMasks));
    let objects = floats(tensor(&belief.outputs, Output::ObjectMasks));
    for pixel in 0..64 * 64 {
        let share = |masks: &[f32]| masks.iter().skip(pixel).step_by(64 * 64).sum::<f32>();
        assert!((share(&slots) + share(&objects) - 1.0).abs() < 1e-4);
    }
    assert_eq!(floats(tensor(&belief.outputs, Output::AgentMask)), slots[..64 * 64]);
    assert!(!belief.objects.is_empty());
    for object in &belief.objects {
        assert!((0.0..=1.0).contains(&object.presence) && object.slot < 7);
        assert!((object.pixel_x - ((object.x + 1.0) * 32.0 - 0.5)).abs() < 1e-4);
    }
    let timing = belief.timing.unwrap();
    assert!(timing.compute_micros > 0);

    let mut request = observation(&session, 2);
    request.outputs = None;
    let silent = server.observe(request).await.unwrap();
    assert!(silent.outputs.is_empty() && silent.objects.is_empty());
    server.app.shutdown().await;
}

#[tokio::test]
async fn encodings_carry_the_same_picture() {
    let server = TestServer::start().await;
    let mut frames = Vec::new();
    for encoding in [Encoding::F32, Encoding::F16, Encoding::U8, Encoding::Png] {
        let session = server.session(4).await;
        let mut request = observation(&session, 0);
        request.outputs =
            Some(outputs(&[Output::Frame, Output::SlotMasks, Output::Latents], encoding));
        let belief = server.observe(request).await.unwrap();
        assert_eq!(belief.outputs.len(), 3);
        frames.push(belief.outputs);
    }
    let bytes: Vec<u8> = floats(tensor(&frames[0], Output::Frame))
        .iter()
        .map(|x| (x * 255.0).round_ties_even() as u8)
        .collect();
    let half = tensor(&frames[1], Output::Frame);
    assert_eq!((half.dtype(), half.data.len()), (v1::DataType::F16, 2 * bytes.len()));
    assert_eq!(tensor(&frames[1], Output::Latents).dtype(), v1::DataType::F16);
    assert_eq!(tensor(&frames[2], Output::Frame).data, bytes);
    assert_eq!(tensor(&frames[2], Output::Latents).dtype(), v1::DataType::F32);
    let png = |output: Output| {
        let value = frames[3].iter().find(|value| value.output() == output).unwrap();
        match value.value.clone().unwrap() {
            v1::output_value::Value::Images(images) => images,
            other => panic!("{other:?}"),
        }
    };
    let frame = png(Output::Frame);
    assert_eq!((frame.shape.len(), frame.png.len()), (0, 1));
    let decoded = image::load_from_memory(&frame.png[0]).unwrap();
    assert_eq!(decoded.into_rgb8().into_raw(), bytes);
    let masks = png(Output::SlotMasks);
    assert_eq!((masks.shape, masks.png.len()), (vec![3], 3));
    let mask = image::load_from_memory(&masks.png[2]).unwrap().into_luma8().into_raw();
    assert_eq!(mask, tensor(&frames[2], Output::SlotMasks).data[2 * 4096..]);
    server.app.shutdown().await;
}

#[tokio::test]
async fn every_way_to_observe_gives_the_same_bytes() {
    let server = TestServer::start().await;
    let wanted = outputs(&[Output::Frame, Output::Surprise, Output::Objects], Encoding::U8);
    let mut request = observation(&server.session(4).await, 0);
    request.outputs = Some(wanted);
    let belief = server.observe(request.clone()).await.unwrap();
    let frame = BASE64_STANDARD.encode(&tensor(&belief.outputs, Output::Frame).data);

    // Step 0's made-up action is that of the request, as JSON, as a form with PNG, and as protobuf.
    let session = server.session(4).await;
    let observation = json!({
        "step": 0,
        "image": { "pixels": {
            "dtype": "DATA_TYPE_U8", "shape": [64, 64, 3],
            "data": BASE64_STANDARD.encode(picture(4, 0)),
        } },
        "action": actions(1, 1, 0),
    });
    let names = ["OUTPUT_FRAME", "OUTPUT_SURPRISE", "OUTPUT_OBJECTS"];
    let body = json!({
        "observation": observation,
        "outputs": { "outputs": names, "encoding": "ENCODING_U8" },
    });
    let path = format!("/v1/sessions/{}/observations", session.id);
    let (status, answer) = server.post_json(&path, &body).await;
    assert_eq!(status, 200, "{answer}");
    assert_eq!(answer["belief"]["outputs"][0]["tensor"]["data"], frame);
    assert_eq!(answer["belief"]["outputs"].as_array().unwrap().len(), 2);
    let x = answer["belief"]["objects"][0]["x"].as_f64().unwrap() as f32;
    assert_eq!(x.to_bits(), belief.objects[0].x.to_bits());

    let session = server.session(4).await;
    let mut file = std::io::Cursor::new(Vec::new());
    let pixels = image::RgbImage::from_raw(64, 64, picture(4, 0)).unwrap();
    pixels.write_to(&mut file, image::ImageFormat::Png).unwrap();
    let action: Vec<String> = actions(1, 1, 0).iter().map(ToString::to_string).collect();
    let form = reqwest::multipart::Form::new()
        .text("step", "0")
        .part("image", reqwest::multipart::Part::bytes(file.into_inner()))
        .text("action", action.join(","))
        .text("outputs", "frame,surprise,objects")
        .text("encoding", "u8");
    let path = format!("/v1/sessions/{}/observations", session.id);
    let response = server.post(&path).multipart(form).send().await.unwrap();
    let answer: serde_json::Value = response.json().await.unwrap();
    assert_eq!(answer["belief"]["outputs"][0]["tensor"]["data"], frame, "{answer}");

    let session = server.session(4).await;
    request.session_id = session.id.clone();
    let path = format!("/v1/sessions/{}/observations", session.id);
    let response = server
        .post(&path)
        .header("content-type", "application/x-protobuf")
        .header("accept", "application/x-protobuf")
        .body(prost::Message::encode_to_vec(&request));
    let bytes = response.send().await.unwrap().bytes().await.unwrap();
    let answer: v1::ObserveResponse = prost::Message::decode(bytes).unwrap();
    assert_eq!(answer.belief.unwrap().outputs, belief.outputs);
    server.app.shutdown().await;
}

#[tokio::test]
async fn steps_come_once_and_in_order() {
    let server = TestServer::start().await;
    let session = server.session(4).await;
    let first = server.observe(observation(&session, 0)).await.unwrap();
    let again = server.observe(observation(&session, 0)).await.unwrap();
    assert_eq!(again, v1::Belief { repeated: true, ..first });

    let mut other = observation(&session, 0);
    other.observation.as_mut().unwrap().action[0] += 0.5;
    let conflict = server.observe(other).await.unwrap_err();
    assert_eq!(conflict.code(), Code::AlreadyExists);
    let gap = server.observe(observation(&session, 2)).await.unwrap_err();
    assert_eq!(gap.code(), Code::FailedPrecondition);
    let info = gap.get_details_error_info().unwrap();
    assert_eq!((info.reason.as_str(), info.metadata["expected_step"].as_str()), ("STEP_GAP", "1"));
    assert_eq!(server.next_step(&session).await, 1);

    // Two clients that both send step 1: it is absorbed once, and both get its answer.
    let (one, two) = tokio::join!(
        server.observe(observation(&session, 1)),
        server.observe(observation(&session, 1))
    );
    let (one, two) = (one.unwrap(), two.unwrap());
    assert_ne!(one.repeated, two.repeated);
    assert_eq!(one.outputs, two.outputs);
    assert_eq!(server.next_step(&session).await, 2);
    let old = server.observe(observation(&session, 0)).await.unwrap_err();
    assert_eq!(old.code(), Code::FailedPrecondition);
    server.app.shutdown().await;
}

#[tokio::test]
async fn a_dropped_frame_is_passed_over() {
    let server = TestServer::start().await;
    let session = server.seasoned(4, 2).await;
    let mut request = observation(&session, 2);
    request.observation.as_mut().unwrap().image = None;
    let wanted = [Output::Frame, Output::Surprise, Output::Keypoints, Output::Objects];
    request.outputs = Some(outputs(&wanted, Encoding::U8));
    let belief = server.observe(request).await.unwrap();
    assert!(belief.predicted);
    assert_eq!(belief.outputs.len(), 1, "nothing that compares with an image");
    assert!(!belief.objects.is_empty());
    let seen = server.observe(observation(&session, 3)).await.unwrap();
    assert!(!seen.predicted);
    server.app.shutdown().await;
}

#[tokio::test]
async fn frames_of_other_sizes_are_fitted() {
    let server = TestServer::start().await;
    // The model crops: what is left and right of the square in the middle does not matter.
    let wide = |edge: u8| -> Vec<u8> {
        (0..128u32)
            .flat_map(|y| (0..192u32).map(move |x| (x, y)))
            .flat_map(|(x, y)| match x {
                32..160 => [(x * 2) as u8, (y * 2) as u8, (x ^ y) as u8],
                _ => [edge; 3],
            })
            .collect()
    };
    let mut beliefs = Vec::new();
    for edge in [0, 255] {
        let session = server.session(4).await;
        let mut request = observation(&session, 0);
        request.observation.as_mut().unwrap().image = Some(u8_image(128, 192, wide(edge)));
        beliefs.push(server.observe(request).await.unwrap());
    }
    assert_eq!(beliefs[0].outputs, beliefs[1].outputs);
    let object = &beliefs[0].objects[0];
    assert!((object.pixel_x - ((object.x + 1.0) * 64.0 - 0.5 + 32.0)).abs() < 1e-3);
    assert!((object.pixel_y - ((object.y + 1.0) * 64.0 - 0.5)).abs() < 1e-3);

    // Numbers in [0, 1] are as good as bytes.
    let (bytes, floats) = (server.session(4).await, server.session(4).await);
    let belief = server.observe(observation(&bytes, 0)).await.unwrap();
    let mut request = observation(&bytes, 0);
    request.session_id = floats.id;
    let numbers: Vec<f32> = picture(4, 0).iter().map(|byte| f32::from(*byte) / 255.0).collect();
    let pixels = Content::Pixels(f32_tensor(&[64, 64, 3], &numbers));
    request.observation.as_mut().unwrap().image = Some(v1::Image { content: Some(pixels) });
    assert_eq!(server.observe(request).await.unwrap().outputs, belief.outputs);
    server.app.shutdown().await;
}

fn streamed(request: v1::ObserveRequest) -> v1::ObserveStreamRequest {
    let v1::ObserveRequest { session_id, observation, outputs, timeout_millis } = request;
    v1::ObserveStreamRequest { session_id, observation, outputs, timeout_millis }
}

#[tokio::test]
async fn a_control_loop_outlives_a_bad_frame() {
    let server = TestServer::start().await;
    let (session, same) = (server.session(4).await, server.session(4).await);
    let (observations, received) = tokio::sync::mpsc::channel(8);
    let mut answers = server
        .sessions
        .clone()
        .observe_stream(ReceiverStream::new(received))
        .await
        .unwrap()
        .into_inner();
    let mut expected = Vec::new();
    for step in 0..4 {
        let mut request = observation(&same, step);
        expected.push(server.observe(request.clone()).await.unwrap().outputs);
        // Only the first message names the session and the outputs.
        request.session_id = if step == 0 { session.id.clone() } else { String::new() };
        if step > 0 {
            request.outputs = None;
        }
        if step == 2 {
            let mut bad = streamed(request.clone());
            bad.observation.as_mut().unwrap().image = Some(u8_image(64, 64, vec![0; 5]));
            observations.send(bad).await.unwrap();
        }
        observations.send(streamed(request)).await.unwrap();
    }
    drop(observations);
    let mut beliefs = Vec::new();
    let mut problems = Vec::new();
    while let Some(answer) = answers.message().await.unwrap() {
        match answer.result.unwrap() {
            Result::Belief(belief) => beliefs.push(belief),
            Result::Problem(problem) => problems.push((beliefs.len(), problem)),
        }
    }
    assert_eq!(beliefs.iter().map(|belief| belief.step).collect::<Vec<_>>(), [0, 1, 2, 3]);
    assert_eq!(beliefs.into_iter().map(|belief| belief.outputs).collect::<Vec<_>>(), expected);
    let [(2, problem)] = problems.as_slice() else { panic!("{problems:?}") };
    assert_eq!(problem.code, Code::InvalidArgument as i32);
    assert_eq!(problem.fields[0].field, "observation.image.pixels.data");

    let mut unknown = streamed(observation(&session, 4));
    unknown.session_id = "0".repeat(32);
    let answers = server.sessions.clone().observe_stream(tokio_stream::once(unknown)).await;
    let status = answers.unwrap().into_inner().message().await.unwrap_err();
    assert_eq!(status.code(), Code::NotFound);
    server.app.shutdown().await;
}

#[tokio::test]
async fn a_fast_camera_loses_images_and_no_actions() {
    let server = TestServer::start().await;
    let request =
        v1::CreateSessionRequest { seed: Some(4), latest_wins: true, ..Default::default() };
    let session = server.sessions.clone().create_session(request).await.unwrap();
    let session = session.into_inner().session.unwrap();
    assert!(session.latest_wins);
    let skipped_before = server.metric("gatsbi_images_skipped_total").await;
    // All observations of the loop have left before the first answer is there.
    let requests: Vec<_> = (0..12).map(|step| streamed(observation(&session, step))).collect();
    let mut sessions = server.sessions.clone();
    let answers = sessions.observe_stream(tokio_stream::iter(requests)).await;
    let mut answers = answers.unwrap().into_inner();
    let mut beliefs = Vec::new();
    while let Some(answer) = answers.message().await.unwrap() {
        let Some(Result::Belief(belief)) = answer.result else { panic!("{answer:?}") };
        beliefs.push(belief);
    }
    assert_eq!(
        beliefs.iter().map(|belief| belief.step).collect::<Vec<_>>(),
        (0..12).collect::<Vec<_>>()
    );
    assert!(beliefs.iter().all(|belief| belief.predicted == belief.image_skipped));
    assert!(!beliefs[0].image_skipped && !beliefs[11].image_skipped, "first and latest are seen");
    let skipped = beliefs.iter().filter(|belief| belief.image_skipped).count();
    assert!(skipped >= 5, "{skipped} of 12");
    let counted = server.metric("gatsbi_images_skipped_total").await - skipped_before;
    assert!(counted >= skipped as f64, "{counted}");

    // It believes what one does whose camera lost the same frames.
    let twin = server.session(4).await;
    for belief in &beliefs {
        let mut request = observation(&twin, belief.step);
        if belief.image_skipped {
            request.observation.as_mut().unwrap().image = None;
        }
        assert_eq!(server.observe(request).await.unwrap().outputs, belief.outputs);
    }
    assert!(server.observe(observation(&session, 11)).await.unwrap().repeated);
    server.app.shutdown().await;
}
